"""What moves, told from what stays: pixels through which a keyframe saw farther.

A keyframe and a frame see each other's surfaces. Where the frame shows something in front of what
the keyframe measured along the same ray, it came since; where it shows something behind what the
keyframe measured, that has gone since. Either contradicts a static world, whereas something farther
than the keyframe's surface was merely hidden. Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3

from .pyramid import DepthNoise, Level, Pyramid

NOTHING_M = 1e4  # the depth of a pixel without one, for minima


@dataclass(frozen=True, slots=True)
class MotionSegmentationConfig:
    is_on: bool = True  # False: the world is taken as static
    level: int = 1  # of the pyramid that is looked at: 160 pixels wide
    least_m: float = 0.06  # by which a surface must contradict: pose errors of a keyframe's length
    sigmas: float = 4.0  # of the depth noise as the alignment estimated it, added to it
    edge_px: int = 2  # a surface so near in the image may be the one that is met: outlines
    least_share: float = 0.0015  # of the image in one piece: what is smaller is noise
    streak_px: int = 5  # a piece must touch what contradicted in the frame before, so far around
    spread_px: int = 8  # how far around what contradicts the same thing may reach: parts of it that
    spread_m: float = 0.12  # are as far away, but were there already, or stand on the floor
    rim_px: int = 1  # around all of it: mixed pixels
    gone_frames: int = 2  # that must see through a keyframe's point before it is believed gone
    renewed_share: float = 0.005  # of the image that has gone from a keyframe, to prepare it anew

    def __post_init__(self) -> None:
        lengths = (self.least_m, self.sigmas, self.spread_m, self.least_share, self.renewed_share)
        counts = (self.level, self.edge_px, self.streak_px, self.spread_px, self.rim_px)
        if min(lengths) < 0 or min(counts) < 0 or not 1 <= self.gone_frames <= 255:
            raise ConfigError(
                named(
                    self,
                    "level",
                    "least_m",
                    "sigmas",
                    "edge_px",
                    "least_share",
                    "streak_px",
                    "spread_px",
                    "spread_m",
                    "rim_px",
                    "gone_frames",
                    "renewed_share",
                )
                + ": nothing negative, gone_frames within 1..255."
            )


@dataclass(frozen=True, eq=False, slots=True)
class MotionEvidence:
    """What is kept from frame to frame, at the level that is looked at.

    contradicts  [h, w] bool, pixels of the last frame that contradict
    gone         [h, w] uint8, in how many frames each point of the keyframe was seen through;
                 None: in none yet
    """

    contradicts: np.ndarray
    gone: np.ndarray | None

    def fits(self, now: Level, then: Level) -> bool:
        is_of_keyframe = self.gone is None or self.gone.shape == then.depth_m.shape
        return is_of_keyframe and self.contradicts.shape == now.depth_m.shape

    def of_new_keyframe(self) -> "MotionEvidence":
        return MotionEvidence(self.contradicts, None)


@dataclass(frozen=True, eq=False, slots=True)
class MotionMasks:
    """dynamic_mask [H, W] bool of the frame and moved_mask [H, W] bool of the keyframe, both at
    working resolution."""

    dynamic_mask: np.ndarray
    moved_mask: np.ndarray
    suspicion: MotionEvidence

    def has_large_change(self, known: np.ndarray | None, config: MotionSegmentationConfig) -> bool:
        """Whether much has moved beside what is known, [H, W] bool; None: nothing is."""
        news = self.moved_mask if known is None else self.moved_mask & ~known
        return bool(np.mean(news) > config.renewed_share)


@dataclass(frozen=True, slots=True)
class _Pair:
    """An aligned frame and its keyframe, at the level that is looked at."""

    now: Level
    then: Level
    T_then_now: np.ndarray  # [4, 4]
    noise: DepthNoise
    noise_scale: float
    config: MotionSegmentationConfig

    def limit_m(self, level: Level) -> np.ndarray:
        """By how much [h, w] a surface may differ from a static one by errors alone."""
        sigma_m = self.noise_scale * self.noise.sigma_m(level.depth_m)
        return self.config.least_m + self.config.sigmas * sigma_m

    def came(self, moved_mask: np.ndarray) -> np.ndarray:
        """Pixels [h, w] bool of the frame in front of what the keyframe saw, or on what moved."""
        ahead_m = depth_gap_m(self.now, self.then, self.T_then_now, self.config)
        limit_m = self.limit_m(self.now)
        on_moved = _lies_on(moved_mask, self.now, self.then, self.T_then_now)
        return (ahead_m > limit_m) | (on_moved & (ahead_m > -limit_m))

    def gone(self, before: MotionEvidence | None) -> np.ndarray:
        """In how many frames [h, w] uint8 each point of the keyframe was seen through."""
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
    """What moved between a keyframe and an aligned frame.

    moved_mask          [H, W] bool of the keyframe as known so far, None: nothing
    T_keyframe_camera  [4, 4]
    noise_scale        of the depth noise, as the alignment estimated it
    before             of the frame before, against this keyframe or, by `of_new_keyframe`, an
                       older one; None: none
    Deterministic. What has stood still since the keyframe was made is static here.
    """
    now, then = _level(view, config), _level(keyframe, config)
    pair = _Pair(now, then, T_keyframe_camera, noise, noise_scale, config)
    known = resized(moved_mask, then.depth_m.shape)
    if before is not None and not before.fits(now, then):
        before = None  # another camera
    came, gone = pair.came(known), pair.gone(before)
    dynamic_mask = _in_pieces(came, None if before is None else before.contradicts, config)
    known = known | _in_pieces(gone >= config.gone_frames, None, config)
    return MotionMasks(
        resized(dynamic_mask, view.levels[0].depth_m.shape),
        resized(known, keyframe.levels[0].depth_m.shape),
        MotionEvidence(came, gone),
    )


def grow_mask(
    dynamic_mask: np.ndarray, view: Pyramid, config: MotionSegmentationConfig
) -> np.ndarray:
    """Pixels [H, W] bool to leave out: what moves, all that is as far away beside it, and a rim.

    dynamic_mask [H, W] bool at working resolution, from `segment_motion`. What this adds must
    not be given to `segment_motion` again, or it would spread on from frame to frame.
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
    """By how much [h, w] each point of `view` lies in front of what `other` measured there.

    The nearest surface within `edge_px` is taken for what was measured, so that outlines that are
    a little off do not count. Negative: behind it; NaN: either measured nothing.
    """
    u, v, z = _seen_from(view, other, T_other_view)
    depth_m = np.where(other.depth_m > 0, other.depth_m, np.float32(NOTHING_M))
    nearest_m = cv2.erode(depth_m, _square(config.edge_px))
    nearest_m[other.depth_m <= 0] = np.nan
    surface_m = cv2.remap(
        nearest_m, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    )
    gap = surface_m - z
    gap[(view.depth_m <= 0) | (z <= 0)] = np.nan
    return gap


def _lies_on(
    moved_mask: np.ndarray, view: Level, keyframe: Level, T_keyframe_view: np.ndarray
) -> np.ndarray:
    """Pixels [h, w] bool of `view` whose ray meets what moved in the keyframe."""
    if not moved_mask.any():
        return np.zeros(view.depth_m.shape, bool)
    u, v, _ = _seen_from(view, keyframe, T_keyframe_view)
    return cv2.remap(_bytes(moved_mask), u, v, cv2.INTER_NEAREST) > 0


def _seen_from(
    view: Level, other: Level, T_other_view: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where [h, w] the points of `view` lie in `other`: u, v in pixels and z in m."""
    R, t = T_other_view[:3, :3], T_other_view[:3, 3].astype(np.float32)
    points = cv2.transform(_rays(view.camera), R.astype(np.float32)) * view.depth_m[..., None] + t
    z = points[..., 2]
    scale = 1 / np.maximum(z, np.float32(1e-3))
    camera = other.camera
    u = np.float32(camera.fx) * points[..., 0] * scale + np.float32(camera.cx)
    v = np.float32(camera.fy) * points[..., 1] * scale + np.float32(camera.cy)
    return u, v, z


@lru_cache(maxsize=8)
def _rays(camera: Camera) -> np.ndarray:
    return camera.rays().astype(np.float32)


def _in_pieces(
    contradicts: np.ndarray, before: np.ndarray | None, config: MotionSegmentationConfig
) -> np.ndarray:
    """Pieces [h, w] bool that are large enough and touch what contradicted before."""
    opened = cv2.morphologyEx(_bytes(contradicts), cv2.MORPH_OPEN, _square(1))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, _square(2))
    count, labels, figures, _ = cv2.connectedComponentsWithStats(closed)
    kept = figures[:, cv2.CC_STAT_AREA] >= max(config.least_share * labels.size, 1)
    kept[0] = False  # what does not contradict
    if before is not None:
        near = cv2.dilate(_bytes(before), _square(config.streak_px)) > 0
        kept &= np.bincount(labels[near], minlength=count) > 0
    return kept[np.asarray(labels, np.int32)]


def _level(view: Pyramid, config: MotionSegmentationConfig) -> Level:
    return view.levels[min(config.level, len(view.levels) - 1)]


def resized(mask: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """A mask [h, w] bool, None for nothing, in another size [H, W]."""
    if mask is None:
        return np.zeros(shape, bool)
    if mask.shape == shape:
        return mask
    return cv2.resize(_bytes(mask), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def _bytes(mask: np.ndarray) -> np.ndarray:
    return mask.astype(np.uint8)


def _square(radius_px: int) -> np.ndarray:
    return np.ones((2 * radius_px + 1,) * 2, np.uint8)
