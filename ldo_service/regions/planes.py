"""Planes of a keyframe, and its structural planes: walls, floors and ceilings.

A pixel with depth z and viewing ray r = (x, y, 1) shows the point z r. If the point lies on the
plane n . p = d, its inverse depth is 1 / z = n . r / d. Inverse depth is thus linear in the image
coordinates, so planes are fitted to it by least squares. The noise of inverse depth is the same at
all distances: 0.0014 / m for a Kinect.

A plane is structural if almost no farther surface is visible past its outline. Floors and walls
end where they meet each other or where an object in front hides them. A table top, a cabinet front
or a seat ends where the camera sees a farther surface past its edge.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera

_3X3 = np.ones((3, 3), np.uint8)
_EPSILON = np.float32(1e-6)


@dataclass(frozen=True, slots=True)
class PlaneConfig:
    """Settings of the planes that are fitted to the depth of a keyframe.

    With the default values, region proposals covered the objects of the sequence `synthetic:flat`
    best. No other sequences were tried. Settings that end in `_px` are in pixels of the small
    image, which is the depth image scaled down to a width of about `width_px`.
    """

    # Width of the small image; at this width, normals over a few pixels are stable enough.
    width_px: int = 320
    # Standard deviation of the Gaussian blur of the inverse depth, before normals are computed.
    blur_px: float = 2.0
    min_cosine: float = 0.94  # Minimum cosine of normals 4 px apart on one surface.
    max_step: float = 0.04  # Maximum relative depth step within 3x3 pixels of one surface.
    # Allowance, 1 / m of inverse depth, by which a step may exceed max_step. At large distances,
    # the noise alone exceeds max_step.
    step_floor: float = 0.004
    min_share: float = 0.01  # Minimum plane size as a fraction of the image.
    most: int = 24  # Maximum number of surfaces to which planes are fitted; the largest are used.
    # Maximum difference, 1 / m, between the inverse depth of a plane and of its pixels.
    tolerance: float = 0.006
    # A plane is structural (a wall, floor or ceiling) if a farther surface is visible past less
    # than this fraction of its outline. Where the image border cuts the plane, no farther surface
    # counts as visible.
    behind: float = 0.3
    # Range of distances outside of the outline in which a farther surface is searched for.
    gap_px: tuple[int, int] = (3, 8)

    def __post_init__(self) -> None:
        shares = self.min_cosine, self.max_step, self.min_share, self.behind
        if not (min(shares) >= 0 and max(shares) <= 1):
            raise ConfigError(
                named(self, "min_cosine", "max_step", "min_share", "behind")
                + ": these settings must be in [0, 1]."
            )
        if min(self.blur_px, self.tolerance, self.step_floor) <= 0 or self.width_px < 16:
            raise ConfigError(
                named(self, "width_px", "blur_px", "step_floor", "tolerance")
                + ": width_px must be at least 16, and the other settings must be positive."
            )
        if not 0 <= self.gap_px[0] < self.gap_px[1]:
            raise ConfigError(
                named(self, "gap_px")
                + ": the first number must be at least 0, and the second must exceed the first."
            )


@dataclass(frozen=True, eq=False, slots=True)
class DepthFeatures:
    """Features of the small image, which is a depth image scaled down to h x w pixels.

    Arrays have the shape [h, w] if no other shape is given.

    Attributes:
        inverse: Measured inverse depth, float32, 1 / m; 0 where unknown.
        smooth: Blurred inverse depth, float32, 1 / m; 0 where unknown.
        normals: Unit normals in the camera frame, pointing away from the camera, [h, w, 3] float32.
        rays: Viewing rays in the camera frame with z = 1, [h, w, 3] float32.
        is_step: True where depth has a step or is unknown, bool.
        surfaces: Number of the smooth surface of each pixel, int32; 0 on edges.
        sizes: Size of each surface in pixels, [S], indexed by its number; sizes[0] (edges) is 0.
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
    """Planes of a keyframe, in the small image (see `PlaneConfig`).

    Attributes:
        number: Number of the plane of each pixel, [h, w] int32, from 1; 0 without a plane.
        inverses: Inverse depth of each plane, extended over the whole image, [h, w] float32,
            1 / m. Plane 1 comes first.
    """

    number: np.ndarray
    inverses: tuple[np.ndarray, ...]


def shrink_factor(width: int, config: PlaneConfig) -> int:
    """Return the factor by which images of this width are scaled down."""
    return max(1, round(width / config.width_px))


def compute_depth_features(
    depth_m: np.ndarray, camera: Camera, config: PlaneConfig
) -> DepthFeatures:
    """Scale a depth image down to a width of about `width_px`, and compute its features.

    Args:
        depth_m: Depth, [H, W], meters; 0 where unknown.
        camera: Intrinsics of the depth.
        config: Settings.
    """
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
    normals /= np.maximum(np.sqrt(dot(normals, normals)), _EPSILON)[..., None]
    low, high = cv2.erode(inverse, _3X3), cv2.dilate(inverse, _3X3)
    is_step = (low <= 0) | (high >= (1 + config.max_step) * low + config.step_floor)
    surfaces, sizes = _pieces(~is_step, normals, config)
    return DepthFeatures(inverse, smooth, normals, rays, is_step, surfaces, sizes)


def planes(seen: DepthFeatures, config: PlaneConfig) -> Planes:
    """Fit planes to the largest surfaces.

    Surfaces on the same plane get the same number. For example, an object in front of a wall may
    divide the wall into two surfaces, but the wall is one plane.
    """
    number, inverses = np.zeros(seen.inverse.shape, np.int32), []
    for piece in np.argsort(-seen.sizes, kind="stable")[: config.most]:
        size = seen.sizes[piece]
        if size < config.min_share * number.size:
            break
        part = (seen.surfaces == piece) & (number == 0)
        if np.count_nonzero(part) < 0.5 * size:
            continue  # Most of the surface belongs to an earlier plane.
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
    """Return the number of the structural plane of each pixel, [h, w] int32; 0 without one.

    A structural plane consists of its pixels in `found` and of pixels up to 15 px around them. A
    pixel is excluded if its distance from the plane exceeds the depth noise.
    """
    out = np.zeros(found.number.shape, np.int32)
    for number, inverse in enumerate(found.inverses, 1):
        part = cv2.morphologyEx((found.number == number).astype(np.uint8), cv2.MORPH_OPEN, _3X3)
        if np.count_nonzero(part) < config.min_share * part.size:
            continue
        part = cv2.morphologyEx(part, cv2.MORPH_CLOSE, disc(3))
        if _share_behind(seen, part, inverse, config) < config.behind:
            # Use unblurred depth: the blur over depth steps would add a ring around each object.
            is_near = np.abs(seen.inverse - inverse) < np.maximum(config.tolerance, 0.02 * inverse)
            reached = (cv2.dilate(part, disc(15)) > 0) & (seen.inverse > 0)
            out[reached & is_near & (out == 0)] = number
    return out


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products of the vectors a and b, [..., 3]; four times faster than `sum`."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def disc(radius_px: int) -> np.ndarray:
    """Return a disc of radius r as a kernel for morphology, [2 r + 1, 2 r + 1] uint8."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1))


def _shrunk_inverse(depth_m: np.ndarray, k: int) -> np.ndarray:
    """Return the mean inverse depth of the measured pixels in each block of k x k pixels, [h, w].

    A block without measured pixels has 0.
    """
    height, width = (side // k * k for side in depth_m.shape)
    depth_m = depth_m[:height, :width]
    measured = (depth_m > 0).astype(np.float32)
    inverse = measured / np.maximum(depth_m, _EPSILON)
    size = width // k, height // k
    total, count = (cv2.resize(a, size, interpolation=cv2.INTER_AREA) for a in (inverse, measured))
    return np.where(count > 0, total / np.maximum(count, _EPSILON), 0).astype(np.float32)


def _blurred(inverse: np.ndarray, sigma_px: float) -> np.ndarray:
    """Blur inverse depth [h, w] over the measured pixels; unmeasured pixels stay 0."""
    measured = (inverse > 0).astype(np.float32)
    total, count = (cv2.GaussianBlur(a, (0, 0), sigma_px) for a in (inverse, measured))
    return measured * total / np.maximum(count, np.float32(1e-3))


def _pieces(
    smooth: np.ndarray, normals: np.ndarray, config: PlaneConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Find connected surfaces with similar normals.

    Args:
        smooth: Pixels without a depth step, [h, w] bool.
        normals: Unit normals, [h, w, 3].
        config: Settings.

    Returns:
        Number of the surface of each pixel, [h, w] int32, 0 on edges; and the size of each surface
        in pixels, by number, [S], with 0 for the edges.
    """
    smooth = smooth.copy()
    smooth[:, 2:-2] &= dot(normals[:, 4:], normals[:, :-4]) > config.min_cosine
    smooth[2:-2] &= dot(normals[4:], normals[:-4]) > config.min_cosine
    _, labels = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    sizes = np.bincount(np.asarray(labels).ravel())
    sizes[0] = 0
    return np.asarray(labels), sizes


def _fitted(seen: DepthFeatures, part: np.ndarray, config: PlaneConfig) -> np.ndarray | None:
    """Fit a plane 1 / z = a x + b y + c to a surface, where (x, y, 1) is the ray of a pixel.

    The fit is repeated twice without outliers.

    Args:
        seen: Features of the small image.
        part: Pixels of the surface, [h, w] bool.
        config: Settings.

    Returns:
        The array (a, b, c), 1 / m; None if the surface is not planar.
    """
    of_part = np.flatnonzero(part)[::4]
    rays = seen.rays.reshape(-1, 3)[of_part]
    inverse = seen.smooth.ravel()[of_part]
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
    """Return the fraction of a plane's outline past which a farther surface is visible, 0..1.

    Pixels just outside of the outline are compared with the extended plane. They may be farther
    than the plane, nearer than it, on it, or cut off by the border of the image. The result is the
    fraction of farther pixels. Pixels on the extended plane do not count.

    Args:
        seen: Features of the small image.
        part: Pixels of the plane, [h, w] uint8.
        inverse: Inverse depth of the extended plane, [h, w], 1 / m.
        config: Settings.
    """
    near, far = config.gap_px
    ring = (cv2.dilate(part, disc(far)) > 0) & (cv2.dilate(part, disc(near)) == 0) & ~seen.is_step
    is_behind = ring & (seen.inverse < (1 - 0.03) * inverse - 0.003)
    is_before = ring & (seen.inverse > (1 + 0.03) * inverse + 0.003)
    cut_px = sum(int(side.sum()) for side in (part[0], part[-1], part[:, 0], part[:, -1]))
    behind = np.count_nonzero(is_behind)
    counted = behind + np.count_nonzero(is_before) + cut_px * (far - near)
    return behind / counted if counted else 0.0
