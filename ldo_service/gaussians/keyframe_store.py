"""Keyframe images on disk, the last used ones in memory, and the training views of them."""

import logging
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, DataError, named
from ldo_service.geometry import Camera
from ldo_service.geometry.point_records import PoseTable
from ldo_service.storage.checksummed_folder import ChecksummedFolder

from .exposure import Exposure
from .training_views import KeyframeImages, TrainingView, pack, unpack
from .visibility import BLOCKS, MaxDepthGrid, PlacedCamera

log = logging.getLogger(__name__)

_DISK_FULL = (
    "The newest keyframes stay in memory (cache_mb), older ones will be missing; free some disk "
    "space, or lower quota_mb."
)


@dataclass(frozen=True, slots=True)
class KeyframeStoreConfig:
    cache_mb: float = 256.0  # in memory: 119 keyframes of 640x480 with 2.15 MB each
    quota_mb: float = 4096.0  # on disk: some 8,000 keyframes of 640x480 with 0.5 MB each
    most: int = 20_000  # on disk, however small: each takes 3 kB of memory too, for its view
    newest_kept: int = 8  # that the quota never touches: they are worked on

    def __post_init__(self) -> None:
        if not (self.cache_mb >= 0 and self.quota_mb > 0 and min(self.newest_kept, self.most) >= 1):
            raise ConfigError(
                named(self, "cache_mb", "quota_mb", "most", "newest_kept")
                + ": cache_mb must be at least 0, quota_mb positive, the others at least 1."
            )


class KeyframeStore:
    """Finds in `folder` what an earlier store left there. Without a folder a temporary one is
    used, which goes when the store does.

    Over the quota, keyframes are forgotten as described at `_most_redundant`. Where the disk takes
    no more, a new keyframe lives as long as the cache holds it. What the store holds depends only
    on what it was given, not on time. Not for two threads at once. Raises ConfigError for a folder
    that cannot be used.
    """

    def __init__(self, folder: Path | None, config: KeyframeStoreConfig | None = None) -> None:
        self.config = config or KeyframeStoreConfig()
        self._files = ChecksummedFolder(folder, "keyframe", _DISK_FULL)
        self._cache: OrderedDict[int, KeyframeImages] = OrderedDict()  # last used last
        self._reads = self._forgotten = self._damaged = 0
        self._make_room()

    def put(self, images: KeyframeImages) -> None:
        """Keep copies. A keyframe that is there already is replaced."""
        images = images.owned()
        self._remember(images)
        self._files.write(images.keyframe, pack(images))
        self._make_room()

    def get(self, keyframe: int) -> KeyframeImages | None:
        """The images, read-only, bit for bit; None when they are not, or no longer, there."""
        images = self._cache.get(keyframe)
        if images is not None:
            self._cache.move_to_end(keyframe)
        elif keyframe in self._files.sizes:
            images = self._read(keyframe)
        return images

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._files.sizes or keyframe in self._cache

    def __len__(self) -> int:
        return len(self._files.sizes.keys() | self._cache.keys())

    def keyframes(self) -> list[int]:
        """Ids of all that are there, ascending."""
        return sorted(self._files.sizes.keys() | self._cache.keys())

    def keep_only(self, keyframes: Iterable[int]) -> None:
        """Drop all others: those that a restored checkpoint does not know."""
        kept = set(keyframes)
        for keyframe in self.keyframes():
            if keyframe not in kept:
                self._drop(keyframe)

    def metrics(self) -> dict[str, float]:
        return {
            "keyframes_stored": len(self),
            "keyframes_disk_mb": sum(self._files.sizes.values()) / 1e6,
            "keyframes_cache_mb": self._cached_bytes() / 1e6,
            "keyframes_read": self._reads,
            "keyframes_forgotten": self._forgotten,
            "keyframes_damaged": self._damaged,
            "keyframes_not_written": self._files.not_written,
        }

    # --- memory -----------------------------------------------------------------------------------
    def _remember(self, images: KeyframeImages) -> None:
        self._cache[images.keyframe] = images
        self._cache.move_to_end(images.keyframe)
        while self._cached_bytes() > 1e6 * self.config.cache_mb:
            self._cache.popitem(last=False)

    def _cached_bytes(self) -> int:
        return sum(images.nbytes for images in self._cache.values())

    # --- disk -------------------------------------------------------------------------------------
    def _read(self, keyframe: int) -> KeyframeImages | None:
        self._reads += 1
        try:
            images = unpack(self._files.read(keyframe))
            if images.keyframe != keyframe:
                raise DataError(f"the file holds keyframe {images.keyframe}")
        except DataError as error:
            log.warning("keyframe %d is dropped, its images cannot be read: %s", keyframe, error)
            self._damaged += 1
            self._drop(keyframe)
            return None
        self._remember(images)
        return images

    def _drop(self, keyframe: int) -> None:
        self._cache.pop(keyframe, None)
        self._files.remove(keyframe)

    # --- quota ------------------------------------------------------------------------------------
    def _make_room(self) -> None:
        sizes, config = self._files.sizes, self.config
        while sum(sizes.values()) > 1e6 * config.quota_mb or len(sizes) > config.most:
            keyframe = self._most_redundant()
            if keyframe is None:
                return
            self._drop(keyframe)
            self._forgotten += 1

    def _most_redundant(self) -> int | None:
        """The keyframe on disk whose neighbours there have the closest ids, the oldest of several:
        it saw least that they did not, and keyframes stay spread over the whole run. Never the
        first, which fixes the map's place and brightness, nor the newest. None: nobody else."""
        kept = np.array(sorted(self._files.sizes), np.int64)
        gaps = (kept[2:] - kept[:-2])[: max(0, len(kept) - 1 - self.config.newest_kept)]
        return int(kept[1 + np.argmin(gaps)]) if len(gaps) else None


class KeyframeViews:
    """Views by keyframe: where each stands is in memory, what it saw is in the store.

    `poses` (T_map_camera [4, 4]) has every keyframe that ever was, for Gaussians hang on it: 136
    bytes each. A view is there while its images are, and so are `cameras`, `exposures` and
    `horizons`, in the same order: 1.5 kB each.
    """

    def __init__(self, store: KeyframeStore) -> None:
        self.store = store
        self.cameras: dict[int, Camera] = {}
        self.poses = PoseTable()
        self.exposures: dict[int, Exposure] = {}
        self.horizons: dict[int, MaxDepthGrid] = {}

    def add(self, view: TrainingView) -> list[int]:
        """The newest one; those without images, of which only their poses are known from now on."""
        if not self.poses:
            self.store.keep_only(())  # what another journey left in the folder
        self.store.put(KeyframeImages.of(view))
        self[view.keyframe] = view
        self.horizons[view.keyframe] = MaxDepthGrid.of(view.depth_m)
        return self._forgotten(view.keyframe)

    def _forgotten(self, newest: int) -> list[int]:
        if len(self.cameras) <= len(self.store):
            return []
        gone = [k for k in self.cameras if k != newest and k not in self.store]
        for table in (self.cameras, self.exposures, self.horizons):
            for keyframe in gone:
                del table[keyframe]
        return gone

    def mask_pixels(self, keyframe: int, pixels: np.ndarray) -> None:
        """Those pixels [H, W] bool of its images count no more. Raises KeyError as a view does."""
        images = self.store.get(keyframe)
        if images is None:
            raise KeyError(keyframe)
        counts = ~pixels if images.mask is None else ~pixels & (images.mask > 0)
        self.store.put(replace(images, mask=counts.astype(np.uint8)))

    def placed(self, keyframe: int) -> PlacedCamera:
        """Its camera where it stands, and how far it saw. Raises KeyError as a view does."""
        camera, T_map_camera = self.cameras[keyframe], self.poses[keyframe]
        return PlacedCamera(camera, T_map_camera, self.horizons[keyframe])

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self.poses

    def __len__(self) -> int:
        return len(self.poses)

    def is_readable(self, keyframe: int) -> bool:
        """Whether its images are still there, and undamaged."""
        return self.store.get(keyframe) is not None

    def __getitem__(self, keyframe: int) -> TrainingView:
        """Raises KeyError when its images were forgotten or cannot be read."""
        images = self.store.get(keyframe)
        if images is None:
            raise KeyError(keyframe)
        return images.view(self.poses[keyframe], self.exposures[keyframe])

    def __setitem__(self, keyframe: int, view: TrainingView) -> None:
        """Take over its camera, pose and exposure."""
        self.cameras[keyframe] = view.camera
        self.poses[keyframe] = view.T_map_camera
        self.exposures[keyframe] = view.exposure

    def snapshot(self) -> dict[str, Any]:
        exposures = [exposure.matrix for exposure in self.exposures.values()]
        horizons = [horizon.farthest_m for horizon in self.horizons.values()]
        return {
            "placed": np.array(list(self.poses), np.int64),
            "keyframes": list(self.cameras),
            "cameras": [(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in self.cameras.values()],
            "T_map_camera": self.poses.of(self.poses),
            "exposures": np.array(exposures, np.float32).reshape(-1, 2, 3),
            "horizons": np.array(horizons, np.float32).reshape(-1, *BLOCKS),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Become what `state` is the snapshot of; images of later keyframes are dropped."""
        keyframes = state["keyframes"]
        self.cameras = dict(zip(keyframes, (Camera(*c) for c in state["cameras"]), strict=True))
        self.poses.become(state["placed"], state["T_map_camera"])
        self.exposures = dict(zip(keyframes, map(Exposure.of, state["exposures"]), strict=True))
        self.horizons = dict(zip(keyframes, map(MaxDepthGrid, state["horizons"]), strict=True))
        self.store.keep_only(keyframes)
