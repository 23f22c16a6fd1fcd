"""Motion segmentation by depth differences between a keyframe and an aligned frame.

Points of the frame are projected into the keyframe, and points of the keyframe into the frame. Each
point is compared with the depth that the other image measures at its pixel:

- A point of the frame lies in front of the keyframe's surface: it has appeared since the keyframe.
- A point of the keyframe lies in front of the frame's surface: it has disappeared since the
  keyframe, as the frame measured depth behind it.

Both cases contradict a static scene. A point of the frame behind the keyframe's surface is no
contradiction, since that surface may have hidden the point. Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3

from .pyramid import DepthNoise, Level, Pyramid

# Minimum fraction of the static pixels that must agree with a keyframe. If fewer agree, the pose of
# the keyframe is wrong. The limit is low because pixels may also show people who stand still.
MIN_AGREEING_RATIO = 0.3
# Minimum fraction of the pixels in a dynamic mask that shows a moving object; fewer are noise.
MIN_DYNAMIC_RATIO = 0.01
NOTHING_M = 1e4  # Depth of an unmeasured pixel in the computation of minima, meters.


@dataclass(frozen=True, slots=True)
class MotionSegmentationConfig:
    """Settings of motion segmentation."""

    is_on: bool = True  # False: the scene is assumed to be static.
    level: int = 1  # Pyramid level of the comparison: 160 pixels wide.
    # Minimum depth difference that contradicts a static scene. It covers the pose errors of
    # frames that are tracked against one keyframe.
    min_m: float = 0.06
    # Multiple of the depth noise, as estimated by alignment, that is added to min_m.
    sigmas: float = 4.0
    # Radius, pixels, within which the nearest surface counts as the measured one. It tolerates
    # object outlines that are off by a few pixels.
    edge_px: int = 2
    # Minimum size of a connected region, fraction of the image; smaller regions are noise.
    min_share: float = 0.0015
    # A region counts only if a pixel of the previous frame within this distance, in pixels, also
    # contradicted a static scene.
    streak_px: int = 5
    # The dynamic mask grows to pixels within this distance and this depth difference. Such pixels
    # show parts of the same object that do not contradict a static scene: parts that were there
    # already, or that stand on the floor.
    spread_px: int = 8
    spread_m: float = 0.12
    rim_px: int = 1  # Margin around the grown mask, for mixed pixels.
    # Number of frames that must measure a depth behind a point of the keyframe before the point
    # counts as moved.
    gone_frames: int = 2
    # The keyframe's mask is updated when more than this fraction of the keyframe's pixels has moved
    # since the last update.
    renewed_share: float = 0.005

    def __post_init__(self) -> None:
        lengths = (self.min_m, self.sigmas, self.spread_m, self.min_share, self.renewed_share)
        counts = (self.level, self.edge_px, self.streak_px, self.spread_px, self.rim_px)
        if min(lengths) < 0 or min(counts) < 0 or not 1 <= self.gone_frames <= 255:
            raise ConfigError(
                named(
                    self,
                    "level",
                    "min_m",
                    "sigmas",
                    "edge_px",
                    "min_share",
                    "streak_px",
                    "spread_px",
                    "spread_m",
                    "rim_px",
                    "gone_frames",
                    "renewed_share",
                )
                + ": no value may be negative, and gone_frames must be within 1..255."
            )


@dataclass(frozen=True, eq=False, slots=True)
class MotionEvidence:
    """State of motion segmentation between frames, at pyramid level `config.level`."""

    contradicts: np.ndarray  # Pixels of the last frame that contradict a static scene, [h, w] bool.
    # Number of frames that measured a depth behind each point of the keyframe, [h, w] uint8; None
    # if it is zero everywhere.
    gone: np.ndarray | None

    def fits(self, now: Level, then: Level) -> bool:
        """Return whether the masks match the sizes of the frame `now` and the keyframe `then`."""
        is_of_keyframe = self.gone is None or self.gone.shape == then.depth_m.shape
        return is_of_keyframe and self.contradicts.shape == now.depth_m.shape

    def of_new_keyframe(self) -> "MotionEvidence":
        """Return the state for a new keyframe, none of whose points has disappeared yet."""
        return MotionEvidence(self.contradicts, None)


@dataclass(frozen=True, eq=False, slots=True)
class MotionMasks:
    """Result of motion segmentation, at the finest pyramid level."""

    # Pixels of the frame that show moving objects, [H, W] bool.
    dynamic_mask: np.ndarray
    # Pixels of the keyframe whose surface is no longer there, [H, W] bool.
    moved_mask: np.ndarray
    evidence: MotionEvidence  # State for the next frame.

    def has_large_change(self, known: np.ndarray | None, config: MotionSegmentationConfig) -> bool:
        """Return whether many pixels of `moved_mask` are not in a known mask.

        Args:
            known: Mask of pixels already known as moved, [H, W] bool; None if there is none.
            config: Settings; `renewed_share` is the limit as a fraction of all pixels.
        """
        news = self.moved_mask if known is None else self.moved_mask & ~known
        return bool(np.mean(news) > config.renewed_share)


@dataclass(frozen=True, slots=True)
class _Pair:
    """Aligned frame (now) and its keyframe (then), at pyramid level `config.level`."""

    now: Level
    then: Level
    T_then_now: np.ndarray  # [4, 4]
    noise: DepthNoise
    noise_scale: float
    config: MotionSegmentationConfig

    def limit_m(self, level: Level) -> np.ndarray:
        """Return the largest depth difference [h, w] in meters that is possible in a static scene.

        This limit covers errors of the pose and noise of the depth.
        """
        sigma_m = self.noise_scale * self.noise.sigma_m(level.depth_m)
        return self.config.min_m + self.config.sigmas * sigma_m

    def came(self, moved_mask: np.ndarray) -> np.ndarray:
        """Return the pixels [h, w] bool of the frame that have appeared since the keyframe.

        Such a pixel lies in front of the keyframe's surface. A pixel that projects onto a moved
        pixel of the keyframe counts too, unless it lies behind the surface of the keyframe.
        """
        ahead_m = depth_gap_m(self.now, self.then, self.T_then_now, self.config)
        limit_m = self.limit_m(self.now)
        on_moved = _lies_on(moved_mask, self.now, self.then, self.T_then_now)
        return (ahead_m > limit_m) | (on_moved & (ahead_m > -limit_m))

    def gone(self, before: MotionEvidence | None) -> np.ndarray:
        """Return how many frames measured a depth behind each point of the keyframe, [h, w] uint8.

        Args:
            before: Counts of the previous frames, to which this frame is added; None if there are
                none.
        """
        ahead_m = depth_gap_m(self.then, self.now, se3.inverse(self.T_then_now), self.config)
        through = _bytes(ahead_m > self.limit_m(self.then))
        count = cv2.morphologyEx(through, cv2.MORPH_OPEN, _square(1))
        known = None if before is None else before.gone
        return count if known is None else cv2.add(count, known)


def segment_motion(
    view: Pyramid,
    keyframe: Pyramid,
    moved_mask: np.ndarray | None,
    T_keyframe_camera: np.ndarray,
    noise_scale: float,
    before: MotionEvidence | None,
    config: MotionSegmentationConfig,
    noise: DepthNoise,
) -> MotionMasks:
    """Segment the pixels that moved between a keyframe and an aligned frame.

    Objects that have not moved since the keyframe count as static. The result is deterministic.

    Args:
        view: Pyramid of the frame.
        keyframe: Pyramid of the keyframe.
        moved_mask: Pixels of the keyframe already known as moved, [H, W] bool; None if there are
            none.
        T_keyframe_camera: Pose of the frame in the keyframe, [4, 4].
        noise_scale: Factor on the depth noise, as estimated by alignment.
        before: State after the previous frame; None if there is none. If the keyframe has changed
            since, pass the result of `MotionEvidence.of_new_keyframe`.
        config: Settings.
        noise: Depth noise of the camera.

    Returns:
        The masks of the frame and of the keyframe, and the state for the next frame.
    """
    now, then = _level(view, config), _level(keyframe, config)
    pair = _Pair(now, then, T_keyframe_camera, noise, noise_scale, config)
    known = resized(moved_mask, then.depth_m.shape)
    if before is not None and not before.fits(now, then):
        before = None  # The evidence is from another camera.
    came, gone = pair.came(known), pair.gone(before)
    dynamic_mask = _in_pieces(came, None if before is None else before.contradicts, config)
    known = known | _in_pieces(gone >= config.gone_frames, None, config)
    return MotionMasks(
        resized(dynamic_mask, view.levels[0].depth_m.shape),
        resized(known, keyframe.levels[0].depth_m.shape),
        MotionEvidence(came, gone),
    )


def shows_motion(dynamic_mask: np.ndarray | None) -> bool:
    """Return whether a dynamic mask [H, W] bool shows a moving object; False without a mask."""
    return dynamic_mask is not None and bool(np.mean(dynamic_mask) > MIN_DYNAMIC_RATIO)


def foreground_mask(
    view: Pyramid,
    keyframe: Pyramid,
    T_keyframe_camera: np.ndarray,
    noise_scale: float,
    config: MotionSegmentationConfig,
    noise: DepthNoise,
    dynamic_mask: np.ndarray,
) -> np.ndarray | None:
    """Return the pixels of a frame that lie in front of the surface measured by a keyframe.

    Args:
        view: Pyramid of the frame.
        keyframe: Pyramid of the keyframe.
        T_keyframe_camera: Pose of the frame in the keyframe, [4, 4].
        noise_scale: Factor on the depth noise, as estimated by alignment.
        config: Settings.
        noise: Depth noise of the camera.
        dynamic_mask: Dynamic pixels of the frame, [H, W] bool at the finest pyramid level.

    Returns:
        [H, W] bool at the finest pyramid level. None if too few of the pixels that are not dynamic
        agree with the keyframe, because T_keyframe_camera is wrong or the keyframe shows another
        surface.
    """
    now, then = _level(view, config), _level(keyframe, config)
    pair = _Pair(now, then, T_keyframe_camera, noise, noise_scale, config)
    ahead_m = depth_gap_m(now, then, T_keyframe_camera, config)
    limit_m = pair.limit_m(now)
    still = ~resized(dynamic_mask, ahead_m.shape) & np.isfinite(ahead_m)
    if not still.any() or np.mean(np.abs(ahead_m) < limit_m, where=still) < MIN_AGREEING_RATIO:
        return None
    pieces = _in_pieces(ahead_m > limit_m, None, config)
    return resized(pieces, view.levels[0].depth_m.shape)


def grow_mask(
    dynamic_mask: np.ndarray, view: Pyramid, config: MotionSegmentationConfig
) -> np.ndarray:
    """Grow a dynamic mask to nearby pixels of similar depth, then by a margin.

    Do not pass the grown mask to `segment_motion`, since the mask would grow from frame to frame.

    Args:
        dynamic_mask: Mask of `segment_motion`, [H, W] bool at the finest pyramid level.
        view: Pyramid of the image that the mask belongs to.
        config: Settings.

    Returns:
        Pixels to ignore, [H, W] bool.
    """
    if not dynamic_mask.any():
        return dynamic_mask
    depth_m = _level(view, config).depth_m
    seed = resized(dynamic_mask, depth_m.shape)
    window = (2 * config.spread_px + 1,) * 2
    measured = (seed & (depth_m > 0)).astype(np.float32)
    share = cv2.boxFilter(measured, -1, window, normalize=False)
    usual_m = cv2.boxFilter(measured * depth_m, -1, window, normalize=False) / np.maximum(share, 1)
    is_beside = (share > 0) & (np.abs(depth_m - usual_m) < config.spread_m)
    whole = cv2.dilate(_bytes(seed | is_beside), _square(config.rim_px)) > 0
    return resized(whole, dynamic_mask.shape)


def depth_gap_m(
    view: Level, other: Level, T_other_view: np.ndarray, config: MotionSegmentationConfig
) -> np.ndarray:
    """Return the distance by which each point of `view` lies in front of the surface of `other`.

    The surface at a pixel is the least depth of `other` within `edge_px` pixels. This tolerates
    object outlines that are displaced by a few pixels.

    Args:
        view: Pyramid level with the points.
        other: Pyramid level with the surface.
        T_other_view: Pose of the camera of `view` in that of `other`, [4, 4].
        config: Settings.

    Returns:
        [h, w] meters. Negative for points behind the surface; NaN where the point or the surface
        was not measured.
    """
    u, v, z = _seen_from(view, other, T_other_view)
    measured_m = np.ascontiguousarray(other.depth_m)
    is_unknown = measured_m <= 0
    depth_m = np.where(is_unknown, np.float32(NOTHING_M), measured_m)
    nearest_m = cv2.erode(depth_m, _square(config.edge_px))
    np.copyto(nearest_m, np.nan, where=is_unknown)
    gap = cv2.remap(
        nearest_m, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    )
    gap -= z
    np.copyto(gap, np.nan, where=(view.depth_m <= 0) | (z <= 0))
    return gap


def _lies_on(
    moved_mask: np.ndarray, view: Level, keyframe: Level, T_keyframe_view: np.ndarray
) -> np.ndarray:
    """Return the pixels [h, w] bool of `view` that project onto moved pixels of the keyframe."""
    if not moved_mask.any():
        return np.zeros(view.depth_m.shape, bool)
    u, v, _ = _seen_from(view, keyframe, T_keyframe_view)
    return cv2.remap(_bytes(moved_mask), u, v, cv2.INTER_NEAREST) > 0


def _seen_from(
    view: Level, other: Level, T_other_view: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project the points of `view` into `other`.

    Returns:
        u, v in pixels and z in meters, [h, w] each.
    """
    R, t = T_other_view[:3, :3], T_other_view[:3, 3].astype(np.float32)
    depth_m = np.ascontiguousarray(view.depth_m)
    # NumPy takes several times as long if the three coordinates of a point are side by side.
    x, y, z = cv2.split(cv2.transform(_rays(view.camera), R.astype(np.float32)))
    for axis, offset in zip((x, y, z), t, strict=True):
        axis *= depth_m
        axis += offset
    scale = np.maximum(z, np.float32(1e-3))
    np.divide(1, scale, out=scale)
    camera = other.camera
    for axis, focal, center in ((x, camera.fx, camera.cx), (y, camera.fy, camera.cy)):
        axis *= np.float32(focal)
        axis *= scale
        axis += np.float32(center)
    return x, y, z


@lru_cache(maxsize=8)
def _rays(camera: Camera) -> np.ndarray:
    return camera.rays().astype(np.float32)


def _in_pieces(
    contradicts: np.ndarray, before: np.ndarray | None, config: MotionSegmentationConfig
) -> np.ndarray:
    """Return the connected regions of a mask that are large and near those of the last frame.

    Args:
        contradicts: Pixels that contradict a static scene, [h, w] bool.
        before: Pixels of the previous frame that contradict a static scene, [h, w] bool. A region
            must come within `streak_px` pixels of one of them. None skips this test.
        config: Settings.

    Returns:
        [h, w] bool.
    """
    opened = cv2.morphologyEx(_bytes(contradicts), cv2.MORPH_OPEN, _square(1))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _square(2))
    count, labels, figures, _ = cv2.connectedComponentsWithStats(closed)
    kept = figures[:, cv2.CC_STAT_AREA] >= max(config.min_share * labels.size, 1)
    kept[0] = False  # Label 0 is the background.
    if before is not None:
        near = cv2.dilate(_bytes(before), _square(config.streak_px)) > 0
        kept &= np.bincount(labels[near], minlength=count) > 0
    return kept[np.asarray(labels, np.int32)]


def _level(view: Pyramid, config: MotionSegmentationConfig) -> Level:
    return view.levels[min(config.level, len(view.levels) - 1)]


def resized(mask: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return a mask [h, w] bool resized to [H, W]; None counts as an empty mask."""
    if mask is None:
        return np.zeros(shape, bool)
    if mask.shape == shape:
        return mask
    return cv2.resize(_bytes(mask), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _bytes(mask: np.ndarray) -> np.ndarray:
    return mask.astype(np.uint8)


def _square(radius_px: int) -> np.ndarray:
    return np.ones((2 * radius_px + 1,) * 2, np.uint8)
