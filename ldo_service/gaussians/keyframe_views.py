"""The keyframes that a map was made from, as views to optimise against."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ldo_service.geometry import Camera
from ldo_service.geometry.point_records import PoseTable

from .anchor_spheres import PlacedCamera
from .exposure import Exposure
from .horizon import BLOCKS, Horizon
from .keyframe_images import KeyframeImages
from .keyframe_store import KeyframeStore
from .views import View


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
        self.horizons: dict[int, Horizon] = {}

    def add(self, view: View) -> list[int]:
        """The newest one; those without images, of which only their poses are known from now on."""
        if not self.poses:
            self.store.keep_only(())  # what another journey left in the folder
        self.store.put(KeyframeImages.of(view))
        self[view.keyframe] = view
        self.horizons[view.keyframe] = Horizon.of(view.depth_m)
        return self._forgotten(view.keyframe)

    def _forgotten(self, newest: int) -> list[int]:
        if len(self.cameras) <= len(self.store):
            return []
        gone = [k for k in self.cameras if k != newest and k not in self.store]
        for table in (self.cameras, self.exposures, self.horizons):
            for keyframe in gone:
                del table[keyframe]
        return gone

    def leave_out(self, keyframe: int, pixels: np.ndarray) -> None:
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

    def __getitem__(self, keyframe: int) -> View:
        """Raises KeyError when its images were forgotten or cannot be read."""
        images = self.store.get(keyframe)
        if images is None:
            raise KeyError(keyframe)
        return images.view(self.poses[keyframe], self.exposures[keyframe])

    def __setitem__(self, keyframe: int, view: View) -> None:
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
        self.horizons = dict(zip(keyframes, map(Horizon, state["horizons"]), strict=True))
        self.store.keep_only(keyframes)
