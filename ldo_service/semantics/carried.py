"""What a keyframe shows of a region that nothing set apart in it: its mask, carried over.

A cushion that stands out in one keyframe is a piece of its couch in the next. Where its surface is
seen again, the mask of its sighting tells which pixels are its own.
"""

import numpy as np
from scipy.spatial import KDTree

from ldo_service.geometry import Camera

from .foreground import Foreground
from .regions import Sighting
from .same_region import is_in, pixels

STRIDE_PX = 4  # of the pixels that are looked at, and the edge of what each stands for
MARGIN_PX = 24  # around the points seen: they are few, and end within their region
LEAST = 12  # pixels looked at that are its own
SPACING = 1.5  # of its points, as they would lie on a square: what is farther from all is behind


def carried(
    seen: Sighting,
    rows: np.ndarray,
    columns: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    T_seen_now: np.ndarray,
    max_gap_m: float,
) -> Foreground | None:
    """The pixels of depth [H, W] whose points lie in the mask of a sighting, and on its surface.

    rows, columns [P]  where points of that surface are seen now
    T_seen_now [4, 4]  from the camera of now to that of the sighting
    max_gap_m          from its surface, or more where its points are farther apart
    Every fourth pixel of a row and of a column is looked at. None where next to nothing is seen.
    """
    row, column, p_now = _points(rows, columns, depth_m, camera)
    p_seen = p_now @ T_seen_now[:3, :3].T + T_seen_now[:3, 3]
    there, across, is_inside = pixels(p_seen, camera, depth_m.shape)
    is_own = is_inside & (p_now[:, 2] > 0) & is_in(seen.candidate.part, there, across)
    near = KDTree(seen.p_camera).query(p_seen[is_own])[0]
    is_own[is_own] = near < max(max_gap_m, SPACING * _spacing_m(seen, camera))
    if np.count_nonzero(is_own) < LEAST:
        return None
    return _enlarged(row[is_own], column[is_own], depth_m.shape)


def _points(
    rows: np.ndarray, columns: np.ndarray, depth_m: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns [N] and points [N, 3] of the grid about what is seen; z 0 where depth is
    missing."""
    grid = np.meshgrid(
        *(
            np.arange(
                max(int(at.min()) - MARGIN_PX, 0) // STRIDE_PX * STRIDE_PX,
                min(int(at.max()) + MARGIN_PX + 1, size),
                STRIDE_PX,
            )
            for at, size in zip((rows, columns), depth_m.shape, strict=True)
        ),
        indexing="ij",
    )
    row, column = (axis.ravel() for axis in grid)
    z = depth_m[row, column].astype(np.float64)
    x, y = (column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z
    return row, column, np.stack([x, y, z], axis=1)


def _spacing_m(seen: Sighting, camera: Camera) -> float:
    """Of a sighting's points, were its area a square full of them."""
    m_per_px = float(np.median(seen.p_camera[:, 2])) / camera.fx
    return float(np.sqrt(seen.size_px / len(seen.p_camera))) * m_per_px


def _enlarged(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, ...]) -> Foreground:
    """Squares of STRIDE_PX at those pixels."""
    top, left = int(rows.min()), int(columns.min())
    small = np.zeros(
        ((int(rows.max()) - top) // STRIDE_PX + 1, (int(columns.max()) - left) // STRIDE_PX + 1),
        bool,
    )
    small[(rows - top) // STRIDE_PX, (columns - left) // STRIDE_PX] = True
    mask = small.repeat(STRIDE_PX, axis=0).repeat(STRIDE_PX, axis=1)
    return Foreground(top, left, mask[: shape[0] - top, : shape[1] - left])
