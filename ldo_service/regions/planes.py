"""Flat pieces of a keyframe, and which of them are the room rather than things in it.

Inverse depth is linear in the image on a plane: n . (ray z) = d gives 1 / z = n . ray / d. So
planes are fitted to it by least squares, and its noise is the same near and far (a Kinect's:
0.0014 / m).

A plane is structure (a wall, a floor, a ceiling) when next to nothing is seen behind it along its
outline: floors meet walls, and things stand before both. A table's top, a cabinet's front or a
seat ends where one looks past it at what is farther away.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera

_3X3 = np.ones((3, 3), np.uint8)
_LEAST = np.float32(1e-6)


@dataclass(frozen=True, slots=True)
class PlaneConfig:
    """Set on `synthetic:flat` by how well regions cover its things, and not varied since. Lengths
    in pixels are those of the small image that all of this is done in."""

    width_px: int = 320  # of that image: normals over a few pixels are steady enough there
    blur_px: float = 2.0  # of inverse depth, before normals are taken
    min_cosine: float = 0.94  # of normals 4 px apart on one surface
    max_step: float = 0.04  # of depth within 3x3 pixels of one surface, share
    step_floor: float = 0.004  # 1 / m, added to it: far away noise is a step
    min_share: float = 0.01  # of the image: smaller pieces are no planes worth fitting
    most: int = 24  # planes, the largest
    tolerance: float = 0.006  # 1 / m, of a plane's pixels
    behind: float = 0.3  # of a plane's outline, with something farther beyond: more, and it is no
    # structure. Where the image ends nobody knows, so this counts as nothing behind
    gap_px: tuple[int, int] = (3, 8)  # from the outline to where that is looked at

    def __post_init__(self) -> None:
        shares = self.min_cosine, self.max_step, self.min_share, self.behind
        if not (min(shares) >= 0 and max(shares) <= 1):
            raise ConfigError(
                named(self, "min_cosine", "max_step", "min_share", "behind")
                + ": shares and the cosine must be within 0..1."
            )
        if min(self.blur_px, self.tolerance, self.step_floor) <= 0 or self.width_px < 16:
            raise ConfigError(
                named(self, "width_px", "blur_px", "step_floor", "tolerance")
                + ": lengths must be positive, width_px at least 16."
            )
        if not 0 <= self.gap_px[0] < self.gap_px[1]:
            raise ConfigError(named(self, "gap_px") + ": gap_px must be two ascending distances.")


@dataclass(frozen=True, eq=False, slots=True)
class DepthFeatures:
    """A depth image made small: [h, w] each.

    inverse  float32, 1 / m, as measured, 0 where nothing is
    smooth   float32, the same, blurred
    normals  [h, w, 3] float32, towards the camera
    rays     [h, w, 3] float32, with z = 1
    is_step  bool, depth jumps here or is missing
    surfaces int32, smooth pieces; 0 on edges; `sizes` [S] px of each
    """

    inverse: np.ndarray
    smooth: np.ndarray
    normals: np.ndarray
    rays: np.ndarray
    is_step: np.ndarray
    surfaces: np.ndarray
    sizes: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class Planes:
    """number    [h, w] int32, which plane a pixel belongs to, 0 for none
    inverses  [P] of [h, w] float32, 1 / m: each plane across the image; plane 1 comes first
    """

    number: np.ndarray
    inverses: tuple[np.ndarray, ...]


def shrink_factor(width: int, config: PlaneConfig) -> int:
    return max(1, round(width / config.width_px))


def compute_depth_features(
    depth_m: np.ndarray, camera: Camera, config: PlaneConfig
) -> DepthFeatures:
    """Of depth [H, W], 0 where it is missing."""
    k = shrink_factor(camera.width, config)
    inverse = _shrunk_inverse(depth_m, k)
    height, width = inverse.shape
    fx, fy = camera.fx / k, camera.fy / k
    middle = (k - 1) / 2
    columns, rows = np.arange(width) * k + middle, np.arange(height) * k + middle
    rays = camera.rays_at(columns, rows[:, None]).astype(np.float32)
    smooth = _blurred(inverse, config.blur_px)
    n_x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=fx / 8)
    n_y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=fy / 8)
    normals = np.stack([n_x, n_y, smooth - n_x * rays[..., 0] - n_y * rays[..., 1]], axis=-1)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), _LEAST)
    low, high = cv2.erode(inverse, _3X3), cv2.dilate(inverse, _3X3)
    is_step = (low <= 0) | (high >= (1 + config.max_step) * low + config.step_floor)
    surfaces, sizes = _pieces(~is_step, normals, config)
    return DepthFeatures(inverse, smooth, normals, rays, is_step, surfaces, sizes)


def planes(seen: DepthFeatures, config: PlaneConfig) -> Planes:
    """Fitted to the largest surfaces. A wall that a thing cuts in two is one plane."""
    number, inverses = np.zeros(seen.inverse.shape, np.int32), []
    for piece in np.argsort(-seen.sizes, kind="stable")[: config.most]:
        size = seen.sizes[piece]
        if size < config.min_share * number.size:
            break
        part = (seen.surfaces == piece) & (number == 0)
        if np.count_nonzero(part) < 0.5 * size:
            continue  # most of it is of a plane by now
        plane = _fitted(seen, part, config)
        if plane is None:
            continue
        inverse = plane[0] * seen.rays[..., 0] + plane[1] * seen.rays[..., 1] + plane[2]
        is_near = np.abs(seen.smooth - inverse) < config.tolerance
        is_along = seen.normals @ (plane / np.linalg.norm(plane)).astype(np.float32) > 0.8
        inverses.append(inverse.astype(np.float32))
        number[(seen.inverse > 0) & is_near & is_along & (number == 0)] = len(inverses)
    return Planes(number, tuple(inverses))


def structural_planes(seen: DepthFeatures, found: Planes, config: PlaneConfig) -> np.ndarray:
    """[h, w] int32, the number of the plane where a pixel lies on one that is structure, or next to
    such a plane and no farther from it than noise; 0 elsewhere."""
    out = np.zeros(found.number.shape, np.int32)
    for number, inverse in enumerate(found.inverses, 1):
        part = cv2.morphologyEx((found.number == number).astype(np.uint8), cv2.MORPH_OPEN, _3X3)
        if np.count_nonzero(part) < config.min_share * part.size:
            continue
        part = cv2.morphologyEx(part, cv2.MORPH_CLOSE, disc(3))
        if _share_behind(seen, part, inverse, config) < config.behind:
            # as measured: what is blurred over a step would be a ring about each thing
            is_near = np.abs(seen.inverse - inverse) < np.maximum(config.tolerance, 0.02 * inverse)
            reached = (cv2.dilate(part, disc(15)) > 0) & (seen.inverse > 0)
            out[reached & is_near & (out == 0)] = number
    return out


def disc(radius_px: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1))


def _shrunk_inverse(depth_m: np.ndarray, k: int) -> np.ndarray:
    """The mean of what is measured in k x k pixels."""
    height, width = (side // k * k for side in depth_m.shape)
    depth_m = depth_m[:height, :width]
    measured = (depth_m > 0).astype(np.float32)
    inverse = measured / np.maximum(depth_m, _LEAST)
    size = width // k, height // k
    total, count = (cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in (inverse, measured))
    return np.where(count > 0, total / np.maximum(count, _LEAST), 0).astype(np.float32)


def _blurred(inverse: np.ndarray, sigma_px: float) -> np.ndarray:
    """Of what is measured alone."""
    measured = (inverse > 0).astype(np.float32)
    total, count = (cv2.GaussianBlur(a, (0, 0), sigma_px) for a in (inverse, measured))
    return measured * total / np.maximum(count, np.float32(1e-3))


def _pieces(
    smooth: np.ndarray, normals: np.ndarray, config: PlaneConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Connected pixels whose normals agree, and their sizes; the edges between count as none."""
    smooth = smooth.copy()
    smooth[:, 2:-2] &= (normals[:, 4:] * normals[:, :-4]).sum(axis=-1) > config.min_cosine
    smooth[2:-2] &= (normals[4:] * normals[:-4]).sum(axis=-1) > config.min_cosine
    _, labels = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    sizes = np.bincount(np.asarray(labels).ravel())
    sizes[0] = 0
    return np.asarray(labels), sizes


def _fitted(seen: DepthFeatures, part: np.ndarray, config: PlaneConfig) -> np.ndarray | None:
    """a, b, c of 1 / z = a x + b y + c; None where it is no plane. Twice without what is off."""
    v, u = np.nonzero(part)
    v, u = v[::4], u[::4]
    rays = seen.rays[v, u]
    inverse = seen.smooth[v, u]
    plane = np.linalg.lstsq(rays, inverse, rcond=None)[0]
    for _ in range(2):
        off = np.abs(rays @ plane - inverse)
        is_on = off <= max(2.5 * float(np.median(off)), 1e-3)
        plane = np.linalg.lstsq(rays[is_on], inverse[is_on], rcond=None)[0]
    off = np.abs(rays @ plane - inverse)
    return plane if float(np.median(off)) <= config.tolerance / 2 else None


def _share_behind(
    seen: DepthFeatures, part: np.ndarray, inverse: np.ndarray, config: PlaneConfig
) -> float:
    """Of the outline of a plane's part: where what is seen beyond is farther than the plane would
    be there. What lies about on the plane does not count."""
    near, far = config.gap_px
    ring = (cv2.dilate(part, disc(far)) > 0) & (cv2.dilate(part, disc(near)) == 0) & ~seen.is_step
    is_behind = ring & (seen.inverse < (1 - 0.03) * inverse - 0.003)
    is_before = ring & (seen.inverse > (1 + 0.03) * inverse + 0.003)
    cut_px = sum(int(side.sum()) for side in (part[0], part[-1], part[:, 0], part[:, -1]))
    behind = np.count_nonzero(is_behind)
    counted = behind + np.count_nonzero(is_before) + cut_px * (far - near)
    return behind / counted if counted else 0.0
