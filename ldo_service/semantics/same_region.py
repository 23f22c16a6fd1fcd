"""Which region of earlier keyframes a sighting is of: what each shows of the other lies in it.

Points on the surface of the one are looked for in the image of the other, and back. Those that it
does not see, being outside of it or hidden, say nothing: so a thing that the image cuts off is
still the same, while a table and what stands on it, or a wall and a picture, are not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera, se3

from .foreground import Foreground
from .regions import Region, Sighting


@dataclass(frozen=True, eq=False, slots=True)
class Projected:
    """Those points of R regions that a keyframe sees: rows, columns and of [P] which region."""

    rows: np.ndarray
    columns: np.ndarray
    of: np.ndarray
    counts: np.ndarray

    def only(self, regions: Sequence[int]) -> "Projected":
        """Those of some of the R regions, each once, numbered as they come."""
        places = np.full(len(self.counts), -1)
        places[regions] = np.arange(len(regions))
        of = places[self.of]
        is_theirs = of >= 0
        points = self.rows[is_theirs], self.columns[is_theirs], of[is_theirs]
        return Projected(*points, self.counts[regions])

    def shares_in(self, part: Foreground) -> np.ndarray:
        """[R] of the points of each region that it sees."""
        inside = is_in(part, self.rows, self.columns)
        hits = np.bincount(self.of[inside], minlength=len(self.counts))
        return hits / np.maximum(self.counts, 1)


def projected(
    regions: Sequence[Region],
    depth_m: np.ndarray,
    camera: Camera,
    T_camera_map: np.ndarray,
    T_map_keyframe: Mapping[int, np.ndarray],
    max_gap_m: float,
) -> Projected:
    """What a keyframe, depth [H, W], sees of the regions' points."""
    points, of = [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for i, region in enumerate(regions):
        T = T_camera_map @ T_map_keyframe[region.shape.keyframe]
        points.append(region.shape.p_camera @ T[:3, :3].T + T[:3, 3])
        of.append(np.full(len(region.shape.p_camera), i))
    p_camera, numbers = np.concatenate(points), np.concatenate(of)
    rows, columns, is_inside = pixels(p_camera, camera, depth_m.shape)
    measured = depth_m[rows, columns]
    is_seen = is_inside & (measured > 0) & (np.abs(measured - p_camera[:, 2]) < max_gap_m)
    counts = np.bincount(numbers[is_seen], minlength=len(regions))
    return Projected(rows[is_seen], columns[is_seen], numbers[is_seen], counts)


def share_back(
    seen: Sighting,
    region: Region,
    shape: tuple[int, ...],
    camera: Camera,
    T_map_keyframe: Mapping[int, np.ndarray],
    least: int,
) -> float:
    """Of the points of a sighting that lie in the image of the region's: the share in its part.

    What something hid there counts against it: a thing that is seen whole now, and was mostly
    hidden at its best so far, is a new region."""
    known = region.shape
    T = se3.inverse(T_map_keyframe[known.keyframe]) @ T_map_keyframe[seen.keyframe]
    rows, columns, is_inside = pixels(seen.p_camera @ T[:3, :3].T + T[:3, 3], camera, shape)
    if np.count_nonzero(is_inside) < least:
        return 0.0
    return float(is_in(known.candidate.part, rows[is_inside], columns[is_inside]).mean())


def pixels(
    p_camera: np.ndarray, camera: Camera, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns [P] of points [P, 3], and which lie in the image."""
    z = p_camera[:, 2]
    far = np.maximum(z, 1e-6)
    u = np.rint(camera.fx * p_camera[:, 0] / far + camera.cx)
    v = np.rint(camera.fy * p_camera[:, 1] / far + camera.cy)
    is_inside = (z > 0) & (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    rows, columns = (np.where(is_inside, x, 0).astype(np.int64) for x in (v, u))
    return rows, columns, is_inside


def is_in(part: Foreground, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """[P] bool"""
    height, width = part.mask.shape
    r, c = rows - part.row, columns - part.column
    inside = (r >= 0) & (c >= 0) & (r < height) & (c < width)
    inside[inside] = part.mask[r[inside], c[inside]]
    return inside
