"""Regions of earlier keyframes, and what a keyframe sees of them."""

from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from ldo_service.geometry import Camera, se3

from .carried import carried
from .foreground import Foreground
from .regions import Region, Sighting
from .same_region import projected, share_back


class KnownRegions:
    """Those whose keyframe is known, as they were before this one: depth [H, W], T_map_keyframe
    [4, 4] by keyframe, this one's too. Points of a region are seen within max_gap_m of their depth,
    and fewer than `least_points` tell nothing."""

    def __init__(
        self,
        regions: Sequence[Region],
        keyframe: int,
        depth_m: np.ndarray,
        camera: Camera,
        T_map_keyframe: Mapping[int, np.ndarray],
        max_gap_m: float,
        least_points: int,
    ) -> None:
        self._regions = [r for r in regions if r.shape.keyframe in T_map_keyframe]
        self._depth_m, self._camera, self._T_map_keyframe = depth_m, camera, T_map_keyframe
        self._keyframe, self._max_gap_m, self._least = keyframe, max_gap_m, least_points
        T_camera_map = se3.inverse(T_map_keyframe[keyframe])
        args = depth_m, camera, T_camera_map, T_map_keyframe, max_gap_m
        self._seen = projected(self._regions, *args)

    def same(self, sighting: Sighting, overlap: float, taken: Collection[int]) -> int | None:
        """The id of the region that it is most of, and that is most of it; but for those taken."""
        shares = self._seen.shares_in(sighting.candidate.part)
        shares[self._seen.counts < self._least] = 0
        place = self._depth_m.shape, self._camera, self._T_map_keyframe
        best, most = None, overlap
        for i in np.flatnonzero(shares >= overlap):
            region = self._regions[int(i)]
            if region.id in taken:
                continue
            back = share_back(sighting, region, *place, self._least)
            if min(back, shares[i]) >= most:
                best, most = region.id, min(back, float(shares[i]))
        return best

    def seen(self) -> Iterator[int]:
        """The ids of those that it sees."""
        for i, region in enumerate(self._regions):
            if self._is_seen(i):
                yield region.id

    def overlaps(self, shown: Sequence[tuple[int, Foreground]]) -> np.ndarray:
        """[M, M], intersection over union of what it shows of regions: of the points of each, the
        share in the other's pixels. 1 of each with itself; 0 of what it sees too little of.

        shown  [M] their ids, each once, and their pixels in it
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

    def carried(self, region: int) -> Foreground | None:
        """The pixels of a region that it sees; see `carried`."""
        i = next(i for i, one in enumerate(self._regions) if one.id == region)
        shape, is_its = self._regions[i].shape, self._seen.of == i
        T_map_now, T_map_seen = (self._T_map_keyframe[k] for k in (self._keyframe, shape.keyframe))
        return carried(
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
