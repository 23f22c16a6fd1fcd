"""Store of keyframe images on disk with a cache in memory, and the views of all keyframes."""

import logging
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.calibration.correction import CameraCorrection, CorrectionChange
from ldo_service.errors import ConfigError, DataError, named
from ldo_service.geometry import Camera
from ldo_service.geometry.point_records import PoseTable
from ldo_service.storage.checksummed_folder import ChecksummedFolder

from .exposure import Exposure
from .training_views import KeyframeImages, TrainingView, pack, unpack
from .visibility import BLOCKS, MaxDepthGrid, PlacedCamera

log = logging.getLogger(__name__)

_DISK_FULL = (
    "Images of new keyframes stay only in memory, up to mapper.keyframe_images.memory_mb, and are "
    "then dropped. To keep them, free some disk space or lower mapper.keyframe_images.disk_mb."
)


@dataclass(frozen=True, slots=True)
class KeyframeStoreConfig:
    """Limits of the keyframe store."""

    cache_mb: float = 256.0  # Maximum memory: 119 keyframes of 640x480 with 2.15 MB each.
    quota_mb: float = 4096.0  # Maximum disk space: 8,000 keyframes of 640x480 with 0.5 MB each.
    # Maximum number of keyframes on disk; the view of each also takes 3 kB of memory.
    max_keyframes: int = 20_000
    # Number of newest keyframes that are never dropped, because the map is fitted to them.
    newest_kept: int = 8

    def __post_init__(self) -> None:
        if not (
            self.cache_mb >= 0
            and self.quota_mb > 0
            and min(self.newest_kept, self.max_keyframes) >= 1
        ):
            raise ConfigError(
                named(self, "cache_mb", "quota_mb", "max_keyframes", "newest_kept")
                + ": cache_mb must be at least 0, quota_mb must be positive, and max_keyframes and "
                "newest_kept must be at least 1."
            )


class KeyframeStore:
    """Store of keyframe images in `folder`, including images that the folder contains already.

    If `folder` is None, the store uses a temporary folder, which it removes when it is closed.
    Above its quota, the store drops the keyframe whose previous and next stored keyframes have the
    closest ids. The previous and the next keyframe then probably show the same surface. If the disk
    is full, a new keyframe is available only while it is in the cache. The content depends only on
    the calls, not on time. Not thread-safe.

    Attributes:
        files: The folder of the images.
        correction: Correction of the camera to which `get` converts images. The files keep the
            images of `put`. None until the first `convert_to`: `get` then converts nothing.

    Raises:
        ConfigError: The folder cannot be used.
    """

    def __init__(self, folder: Path | None, config: KeyframeStoreConfig | None = None) -> None:
        self.config = config or KeyframeStoreConfig()
        self.files = ChecksummedFolder(folder, "keyframe", _DISK_FULL)
        self.correction: CameraCorrection | None = None
        self._is_converting = False  # True if `get` may return other images than those of `put`.
        self._cache: OrderedDict[int, KeyframeImages] = OrderedDict()  # Least recently used first.
        self._reads = self._forgotten = self._damaged = 0
        self._make_room()

    def put(self, images: KeyframeImages) -> None:
        """Store copies of the images of a keyframe; images stored earlier for it are replaced."""
        images = images.owned()
        self._remember(self._converted(images))
        self.files.write(images.keyframe, pack(images))
        self._make_room()

    def get(self, keyframe: int) -> KeyframeImages | None:
        """Return the images of a keyframe, read-only and in `correction`; None if unavailable."""
        images = self._cache.get(keyframe)
        if images is not None:
            self._cache.move_to_end(keyframe)
            return images
        images = self._read(keyframe)
        if images is not None:
            images = self._converted(images)
            self._remember(images)
        return images

    def convert_to(self, correction: CameraCorrection | None) -> None:
        """Convert the images of later `get` calls from their own correction to this one."""
        self.correction = correction
        self._is_converting |= len(self) > 0
        for keyframe in [k for k in self._cache if k in self.files.sizes]:
            del self._cache[keyframe]
        self._cache = OrderedDict((k, self._converted(i)) for k, i in self._cache.items())

    def _converted(self, images: KeyframeImages) -> KeyframeImages:
        return images if self.correction is None else images.recorrected(self.correction)

    def mask_pixels(self, keyframe: int, pixels: np.ndarray) -> None:
        """Exclude pixels [H, W] bool of a keyframe from fitting.

        Raises:
            KeyError: The images of the keyframe are dropped or unreadable.
        """
        images = self._cache.get(keyframe)
        if images is None or self._is_converting:
            images = self._read(keyframe) or images
        if images is None:
            raise KeyError(keyframe)
        counts = ~pixels if images.mask is None else ~pixels & (images.mask > 0)
        self.put(replace(images, mask=counts.astype(np.uint8)))

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self.files.sizes or keyframe in self._cache

    def __len__(self) -> int:
        return len(self.files.sizes.keys() | self._cache.keys())

    def keyframes(self) -> list[int]:
        """Return the ids of all stored keyframes, ascending."""
        return sorted(self.files.sizes.keys() | self._cache.keys())

    def keep_only(self, keyframes: Iterable[int]) -> None:
        """Drop all keyframes except the given ones, such as the keyframes of a checkpoint."""
        kept = set(keyframes)
        for keyframe in self.keyframes():
            if keyframe not in kept:
                self._drop(keyframe)

    def metrics(self) -> dict[str, float]:
        """Return the counters and limits of the store."""
        return {
            "keyframes_stored": len(self),
            "keyframes_stored_max": self.config.max_keyframes,
            "keyframes_disk_mb": sum(self.files.sizes.values()) / 1e6,
            "keyframes_disk_max_mb": self.config.quota_mb,
            "keyframes_cache_mb": self._cached_bytes() / 1e6,
            "keyframes_read": self._reads,
            "keyframes_forgotten": self._forgotten,
            "keyframes_damaged": self._damaged,
            "keyframes_not_written": self.files.not_written,
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
        """Return the images of a keyframe as they were stored; None if no valid file has them."""
        if keyframe not in self.files.sizes:
            return None
        self._reads += 1
        try:
            images = unpack(self.files.read(keyframe))
            if images.keyframe != keyframe:
                raise DataError(
                    f"the file contains keyframe {images.keyframe} instead of keyframe {keyframe}"
                )
        except DataError as error:
            log.warning(
                "keyframe store: the images of keyframe %d cannot be read (%s). They are dropped, "
                "and the map is no longer fitted to this keyframe. Check the disk.",
                keyframe,
                error,
            )
            self._damaged += 1
            self._drop(keyframe)
            return None
        return images

    def _drop(self, keyframe: int) -> None:
        self._cache.pop(keyframe, None)
        self.files.remove(keyframe)

    # --- quota ------------------------------------------------------------------------------------
    def _make_room(self) -> None:
        sizes, config = self.files.sizes, self.config
        while sum(sizes.values()) > 1e6 * config.quota_mb or len(sizes) > config.max_keyframes:
            keyframe = self._most_redundant()
            if keyframe is None:
                return
            self._drop(keyframe)
            self._forgotten += 1

    def _most_redundant(self) -> int | None:
        """Return the keyframe on disk whose neighbors on disk have ids closest to each other.

        The neighbors are the previous and the next keyframe on disk. They probably show the same
        surface as the returned keyframe, and the remaining keyframes stay spread over the whole
        run. Of several such keyframes, the oldest is returned. The first keyframe is never
        returned, since it fixes the pose and the brightness of the map. The `newest_kept` newest
        keyframes are never returned either.

        Returns:
            Id of the keyframe, or None if no keyframe may be dropped.
        """
        kept = np.array(sorted(self.files.sizes), np.int64)
        gaps = (kept[2:] - kept[:-2])[: max(0, len(kept) - 1 - self.config.newest_kept)]
        return int(kept[1 + np.argmin(gaps)]) if len(gaps) else None


class KeyframeViews:
    """Training views by keyframe id, with images in a `KeyframeStore` and the rest in memory.

    A training view exists only while its images are stored.

    Attributes:
        store: The images.
        cameras: Intrinsics of each keyframe with images.
        poses: T_map_camera [4, 4] of every keyframe of the run. A pose remains when the images are
            dropped, since Gaussians are anchored to the keyframe. A pose takes 136 bytes.
        exposures: Exposure of each keyframe with images.
        horizons: Largest depths in the blocks of the image, for each keyframe with images.
            `cameras`, `exposures` and `horizons` list the keyframes in the same order. Together
            they take 1.5 kB per keyframe.
    """

    def __init__(self, store: KeyframeStore) -> None:
        self.store = store
        self.cameras: dict[int, Camera] = {}
        self.poses = PoseTable()
        self.exposures: dict[int, Exposure] = {}
        self.horizons: dict[int, MaxDepthGrid] = {}
        # Keyframes of an older version of LDO-SLAM, whose correction is unknown.
        self._unconverted: set[int] = set()

    def add(self, view: TrainingView, horizon: MaxDepthGrid) -> list[int]:
        """Add the newest keyframe.

        Args:
            view: The keyframe.
            horizon: Largest depths in the blocks of its depth image.

        Returns:
            The keyframes whose images the store has dropped; only their poses remain.
        """
        if not self.poses:
            self.store.keep_only(())  # Drop images of an earlier run in the folder.
        self.store.put(KeyframeImages.of(view, self.store.correction or CameraCorrection()))
        self[view.keyframe] = view
        self.horizons[view.keyframe] = horizon
        return self._forgotten(view.keyframe)

    def _forgotten(self, newest: int) -> list[int]:
        if len(self.cameras) <= len(self.store):
            return []
        gone = [k for k in self.cameras if k != newest and k not in self.store]
        for table in (self.cameras, self.exposures, self.horizons):
            for keyframe in gone:
                del table[keyframe]
        return gone

    def convert_to(self, correction: CameraCorrection) -> None:
        """Convert all keyframes to a correction of the camera, for images that arrive with it.

        The horizons stay, because the Gaussians of these keyframes stay where they were added.

        Args:
            correction: The correction; the times of the shutter do not matter.
        """
        before, now = self.store.correction, correction.of_images
        if before == now:
            return
        self.store.convert_to(now)
        if before is None:
            return
        change = CorrectionChange(before, now)
        for keyframe, exposure in self.exposures.items():
            if keyframe not in self._unconverted:
                factor = change.brightness(self.cameras[keyframe])
                self.exposures[keyframe] = Exposure(factor * exposure.gain, factor * exposure.bias)

    def placed(self, keyframe: int) -> PlacedCamera:
        """Return the camera and pose of a keyframe, with the largest depth in each image block.

        Raises:
            KeyError: The keyframe is unknown or its images are dropped.
        """
        camera, T_map_camera = self.cameras[keyframe], self.poses[keyframe]
        return PlacedCamera(camera, T_map_camera, self.horizons[keyframe])

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self.poses

    def __len__(self) -> int:
        return len(self.poses)

    def is_readable(self, keyframe: int) -> bool:
        """Return whether the images of a keyframe exist and are undamaged."""
        return self.store.get(keyframe) is not None

    def __getitem__(self, keyframe: int) -> TrainingView:
        """Return the training view of a keyframe.

        Raises:
            KeyError: The images of the keyframe are dropped or unreadable.
        """
        images = self.store.get(keyframe)
        if images is None:
            raise KeyError(keyframe)
        return images.view(self.poses[keyframe], self.exposures[keyframe])

    def __setitem__(self, keyframe: int, view: TrainingView) -> None:
        """Set camera, pose and exposure of a keyframe from its view."""
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
            "correction": self.store.correction and self.store.correction.pack(),
            "unconverted": sorted(self._unconverted),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore the state of a `snapshot`; images of later keyframes are dropped."""
        keyframes = state["keyframes"]
        self.cameras = dict(zip(keyframes, (Camera(*c) for c in state["cameras"]), strict=True))
        self.poses.become(state["placed"], state["T_map_camera"])
        self.exposures = dict(zip(keyframes, map(Exposure.of, state["exposures"]), strict=True))
        self.horizons = dict(zip(keyframes, map(MaxDepthGrid, state["horizons"]), strict=True))
        self.store.keep_only(keyframes)
        # Older versions of LDO-SLAM saved neither of the two.
        self._unconverted = set(state.get("unconverted", keyframes))
        correction = state.get("correction")
        self.store.convert_to(correction and CameraCorrection.of(correction))
