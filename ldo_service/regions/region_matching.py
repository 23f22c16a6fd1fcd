"""Matching of a keyframe's regions with region tracks, and mask propagation between keyframes."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from ldo_service.geometry import Camera, se3

from .foreground import Foreground
from .region import Region, RegionObservation

# Distance between sampled pixels, and side of the square of the mask that each sample represents.
STRIDE_PX = 4
# Margin around a region's visible points in which pixels are sampled. The points are few and do not
# reach the edges of the region.
MARGIN_PX = 24
MIN_PIXELS = 12  # Minimum sampled pixels of a propagated mask.
# Maximum distance of a pixel's point from the nearest point of the region, as a multiple of the
# spacing of the region's points. A point farther away lies on a surface behind the region.
SPACING = 1.5


@dataclass(frozen=True, eq=False, slots=True)
class ProjectedPoints:
    """Points of R regions that are visible in a keyframe.

    Attributes:
        rows: Rows of the points in the image, [P] int64.
        columns: Columns of the points in the image, [P] int64.
        of: Index of the region of each point, [P], 0..R-1.
        counts: Number of visible points of each region, [R].
    """

    rows: np.ndarray
    columns: np.ndarray
    of: np.ndarray
    counts: np.ndarray

    def only(self, regions: Sequence[int]) -> "ProjectedPoints":
        """Return the points of some regions only.

        Args:
            regions: Indices of the regions, without repetition. Region `regions[i]` gets the new
                index i.
        """
        places = np.full(len(self.counts), -1)
        places[regions] = np.arange(len(regions))
        of = places[self.of]
        is_theirs = of >= 0
        points = self.rows[is_theirs], self.columns[is_theirs], of[is_theirs]
        return ProjectedPoints(*points, self.counts[regions])

    def shares_in(self, part: Foreground) -> np.ndarray:
        """Return the fraction of each region's visible points that lie in a mask, [R], 0..1."""
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
) -> ProjectedPoints:
    """Project the points of regions into a keyframe, and return the points that are visible there.

    Args:
        regions: Regions with points.
        depth_m: Depth of the keyframe, [H, W], meters; 0 where unknown.
        camera: Intrinsics of all keyframes.
        T_camera_map: Transform from the map to the keyframe, [4, 4].
        T_map_keyframe: Current poses of the regions' keyframes, [4, 4], by id.
        max_gap_m: Maximum difference between the depth of a visible point and the measured depth.
    """
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
    return ProjectedPoints(rows[is_seen], columns[is_seen], numbers[is_seen], counts)


def reverse_overlap(
    seen: RegionObservation,
    region: Region,
    shape: tuple[int, ...],
    camera: Camera,
    T_map_keyframe: Mapping[int, np.ndarray],
    least: int,
) -> float:
    """Return the fraction of an observation's points that lie in the mask of a known region.

    `region.shape` is the stored observation of the region. The points are projected into the
    keyframe of this observation. Points outside of that image are not counted. Points that were
    occluded in that keyframe count as outside of the mask and lower the fraction. An object that
    was mostly occluded in the stored observation and is fully visible now therefore becomes a new
    region.

    Args:
        seen: The new observation.
        region: The known region.
        shape: Height and width of the images.
        camera: Intrinsics of all keyframes.
        T_map_keyframe: Current poses of both keyframes, [4, 4], by id.
        least: Minimum points inside the image; with fewer, the result is 0.
    """
    known = region.shape
    T = se3.inverse(T_map_keyframe[known.keyframe]) @ T_map_keyframe[seen.keyframe]
    rows, columns, is_inside = pixels(seen.p_camera @ T[:3, :3].T + T[:3, 3], camera, shape)
    if np.count_nonzero(is_inside) < least:
        return 0.0
    return float(is_in(known.candidate.part, rows[is_inside], columns[is_inside]).mean())


def pixels(
    p_camera: np.ndarray, camera: Camera, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points [P, 3] in the camera frame, meters, to pixels of an image of this shape.

    Returns:
        The row of each point, [P] int64; the column of each point, [P] int64; and True for each
        point in the image, [P] bool. Row and column are 0 for points outside of the image.
    """
    z = p_camera[:, 2]
    far = np.maximum(z, 1e-6)
    u = np.rint(camera.fx * p_camera[:, 0] / far + camera.cx)
    v = np.rint(camera.fy * p_camera[:, 1] / far + camera.cy)
    is_inside = (z > 0) & (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    rows, columns = (np.where(is_inside, x, 0).astype(np.int64) for x in (v, u))
    return rows, columns, is_inside


def is_in(part: Foreground, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return whether each of P pixels, given by row and column, lies in a mask, [P] bool."""
    height, width = part.mask.shape
    r, c = rows - part.row, columns - part.column
    inside = (r >= 0) & (c >= 0) & (r < height) & (c < width)
    inside[inside] = part.mask[r[inside], c[inside]]
    return inside


def propagate_mask(
    seen: RegionObservation,
    rows: np.ndarray,
    columns: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    T_seen_now: np.ndarray,
    max_gap_m: float,
) -> Foreground | None:
    """Project a region's mask from an earlier keyframe into the current one.

    In the current keyframe, every fourth pixel of every fourth row around the region is sampled.
    The 3D point of such a pixel is projected into the earlier keyframe. The pixel belongs to the
    region if the point lies in the mask and on the surface of the earlier observation.

    Args:
        seen: The earlier observation of the region.
        rows: Rows of the region's visible points in the current keyframe, [P].
        columns: Columns of the visible points, [P].
        depth_m: Depth of the current keyframe, [H, W], meters; 0 where unknown.
        camera: Intrinsics of both keyframes.
        T_seen_now: Transform from the current camera to the earlier one, [4, 4].
        max_gap_m: Maximum distance of a pixel's point from the nearest point of the earlier
            observation. If 1.5 times the spacing of the observation's points is larger than
            `max_gap_m`, this larger distance is the maximum instead.

    Returns:
        The mask in the current keyframe, or None if fewer than 12 sampled pixels belong to the
        region.
    """
    row, column, p_now = _points(rows, columns, depth_m, camera)
    p_seen = p_now @ T_seen_now[:3, :3].T + T_seen_now[:3, 3]
    there, across, is_inside = pixels(p_seen, camera, depth_m.shape)
    is_own = is_inside & (p_now[:, 2] > 0) & is_in(seen.candidate.part, there, across)
    near = KDTree(seen.p_camera).query(p_seen[is_own])[0]
    is_own[is_own] = near < max(max_gap_m, SPACING * _spacing_m(seen, camera))
    if np.count_nonzero(is_own) < MIN_PIXELS:
        return None
    return _enlarged(row[is_own], column[is_own], depth_m.shape)


def _points(
    rows: np.ndarray, columns: np.ndarray, depth_m: np.ndarray, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample a grid of pixels around a region's visible points.

    Returns:
        Rows, [N], and columns, [N], of the pixels, and their 3D points in the camera frame, [N, 3],
        meters; z is 0 where depth is unknown.
    """
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
    return row, column, camera.points_at(column, row, depth_m[row, column])


def _spacing_m(seen: RegionObservation, camera: Camera) -> float:
    """Return the spacing of an observation's points in meters, assuming a square grid."""
    m_per_px = float(np.median(seen.p_camera[:, 2])) / camera.fx
    return float(np.sqrt(seen.size_px / len(seen.p_camera))) * m_per_px


def _enlarged(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, ...]) -> Foreground:
    """Return a mask with a square of side STRIDE_PX at each of these sampled pixels.

    Args:
        rows: Rows of the upper left corners of the squares, [N].
        columns: Columns of the corners, [N].
        shape: Height and width of the image.
    """
    top, left = int(rows.min()), int(columns.min())
    small = np.zeros(
        ((int(rows.max()) - top) // STRIDE_PX + 1, (int(columns.max()) - left) // STRIDE_PX + 1),
        bool,
    )
    small[(rows - top) // STRIDE_PX, (columns - left) // STRIDE_PX] = True
    mask = small.repeat(STRIDE_PX, axis=0).repeat(STRIDE_PX, axis=1)
    return Foreground(top, left, mask[: shape[0] - top, : shape[1] - left])


class RegionMatcher:
    """Matcher of known regions with the regions of one keyframe."""

    def __init__(
        self,
        regions: Sequence[Region],
        keyframe: int,
        depth_m: np.ndarray,
        camera: Camera,
        T_map_keyframe: Mapping[int, np.ndarray],
        max_gap_m: float,
        min_points: int,
    ) -> None:
        """Project the points of known regions into a keyframe.

        Args:
            regions: Regions as they were before this keyframe. A region whose keyframe has no pose
                in T_map_keyframe is ignored.
            keyframe: Id of the keyframe.
            depth_m: Depth of the keyframe, [H, W], meters; 0 where unknown.
            camera: Intrinsics of all keyframes.
            T_map_keyframe: Current poses of this keyframe and of the regions' keyframes, [4, 4], by
                id.
            max_gap_m: Maximum difference between the depth of a visible point and the measured
                depth.
            min_points: Minimum visible points of a region; with fewer, it is not matched.
        """
        self._regions = [r for r in regions if r.shape.keyframe in T_map_keyframe]
        self._depth_m, self._camera, self._T_map_keyframe = depth_m, camera, T_map_keyframe
        self._keyframe, self._max_gap_m, self._least = keyframe, max_gap_m, min_points
        T_camera_map = se3.inverse(T_map_keyframe[keyframe])
        args = depth_m, camera, T_camera_map, T_map_keyframe, max_gap_m
        self._seen = projected(self._regions, *args)

    def same(
        self, observation: RegionObservation, overlap: float, taken: Collection[int]
    ) -> int | None:
        """Return the id of the region that matches an observation best; None if none matches.

        Args:
            observation: The observation.
            overlap: Minimum fraction of the region's points in the mask of the observation, and of
                the observation's points in the mask of the region.
            taken: Ids of regions that are matched already.
        """
        shares = self._seen.shares_in(observation.candidate.part)
        shares[self._seen.counts < self._least] = 0
        place = self._depth_m.shape, self._camera, self._T_map_keyframe
        best, most = None, overlap
        for i in np.flatnonzero(shares >= overlap):
            region = self._regions[int(i)]
            if region.id in taken:
                continue
            back = reverse_overlap(observation, region, *place, self._least)
            if min(back, shares[i]) >= most:
                best, most = region.id, min(back, float(shares[i]))
        return best

    def seen(self) -> Iterator[int]:
        """Yield the ids of the regions with at least `min_points` visible points."""
        for i, region in enumerate(self._regions):
            if self._is_seen(i):
                yield region.id

    def overlaps(self, shown: Sequence[tuple[int, Foreground]]) -> np.ndarray:
        """Estimate the IoU of the masks of each pair of M regions in the matcher's keyframe.

        The IoU of regions a and b is estimated from two fractions: the fraction of a's points in
        the mask of b, and the fraction of b's points in the mask of a.

        Args:
            shown: Ids of M regions, each once, and their masks in the keyframe.

        Returns:
            The IoU, [M, M], with 1 on the diagonal. If a region has too few visible points, its IoU
            with all other regions is 0.
        """
        places = {region.id: i for i, region in enumerate(self._regions)}
        inside = np.zeros((len(shown), len(shown)))
        columns = [k for k, (id_, _) in enumerate(shown) if self._is_seen(places.get(id_))]
        seen = self._seen.only([places[shown[k][0]] for k in columns])
        for row, (_, part) in zip(inside, shown, strict=True):
            row[columns] = seen.shares_in(part)
        both = inside * inside.T
        iou = both / np.maximum(inside + inside.T - both, 1e-9)
        np.fill_diagonal(iou, 1)
        return iou

    def propagated(self, region: int) -> Foreground | None:
        """Project the mask of a known region into the matcher's keyframe; see `propagate_mask`."""
        i = next(i for i, one in enumerate(self._regions) if one.id == region)
        shape, is_its = self._regions[i].shape, self._seen.of == i
        T_map_now, T_map_seen = (self._T_map_keyframe[k] for k in (self._keyframe, shape.keyframe))
        return propagate_mask(
            shape,
            self._seen.rows[is_its],
            self._seen.columns[is_its],
            self._depth_m,
            self._camera,
            se3.inverse(T_map_seen) @ T_map_now,
            self._max_gap_m,
        )

    def _is_seen(self, place: int | None) -> bool:
        return place is not None and bool(self._seen.counts[place] >= self._least)
