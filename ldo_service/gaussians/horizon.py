"""How far a camera saw: what lies wholly behind that is hidden from it."""

from dataclasses import dataclass
from math import inf

import numpy as np

from ldo_service.geometry import Camera

from .insertion import with_small_holes_filled

BLOCKS = 12, 16  # of an image, down and to the right: 0.8 kB
BEHIND = 0.1  # share of the depth: nearer to the surface than that is seen, as depth is noisy
LOW_PASS_PX = 2.0  # 3.33 times the square root of the 0.3 px^2 that every splat is widened by
_HOLE_PX = 4  # as insertion fills holes: shadows beside an object lie on what is behind it


@dataclass(frozen=True, eq=False, slots=True)
class Horizon:
    """farthest_m [12, 16] float32: the farthest depth in each block of an image; infinite where
    not all of the block was measured."""

    farthest_m: np.ndarray

    @classmethod
    def of(cls, depth_m: np.ndarray) -> "Horizon":
        """depth_m [H, W] float32, 0 where not measured."""
        filled_m = with_small_holes_filled(depth_m, _HOLE_PX)
        known_m = np.where(filled_m > 0, filled_m, np.float32(inf))
        for axis, edges in enumerate(_edges(depth_m.shape)):
            known_m = np.maximum.reduceat(known_m, edges[:-1], axis=axis)
        return cls(known_m)

    def hides(self, camera: Camera, centers_camera: np.ndarray, radii_m: np.ndarray) -> np.ndarray:
        """Which spheres [K] bool lie wholly behind what `camera` saw in every block that they may
        show in.

        centers_camera [K, 3], radii_m [K]. False for some that are hidden; true for none that is
        not, nor for any that holds NaN.
        """
        downward, rightward = _edges((camera.height, camera.width))
        rows = _between(centers_camera[:, 1:], radii_m, downward, camera.fy, camera.cy)
        columns = _between(centers_camera[:, ::2], radii_m, rightward, camera.fx, camera.cx)
        nearest_m = centers_camera[:, 2] - radii_m
        in_sight = ~(nearest_m[:, None, None] > (1 + BEHIND) * self.farthest_m)
        return ~np.any(in_sight & rows[:, :, None] & columns[:, None, :], axis=(1, 2))


def _edges(shape: tuple[int, ...]) -> list[np.ndarray]:
    """First pixel of each block, and one past the last, down and to the right."""
    return [
        np.linspace(0, pixels, blocks + 1).astype(int)
        for pixels, blocks in zip(shape, BLOCKS, strict=True)
    ]


def _between(
    centers: np.ndarray, radii_m: np.ndarray, edges: np.ndarray, focal_px: float, center_px: float
) -> np.ndarray:
    """Whether each sphere [K] touches each wedge [B] between two neighbouring edges; centers
    [K, 2] are across the edges and z."""
    low = edges[:-1] - 0.5 - LOW_PASS_PX - center_px
    high = edges[1:] - 0.5 + LOW_PASS_PX - center_px
    beyond_low, before_high = (
        (centers[:, :1] * focal_px - centers[:, 1:] * edge) / np.hypot(focal_px, edge)
        for edge in (low, high)
    )
    return ~((beyond_low < -radii_m[:, None]) | (before_high > radii_m[:, None]))
