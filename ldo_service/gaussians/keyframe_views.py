"""The keyframes that a map was made from, as views to optimise against."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.geometry import Camera

from .exposure import Exposure
from .keyframe_images import KeyframeImages
from .keyframe_store import KeyframeStore
from .views import View


@dataclass(frozen=True, eq=False, slots=True)
class Stand:
    """What of a keyframe may change, and its camera: 0.5 kB in memory."""

    camera: Camera
    T_map_camera: np.ndarray  # [4, 4]
    exposure: Exposure = field(default_factory=Exposure)


class KeyframeViews:
    """Views by keyframe: where each stands is in memory, what it saw is in the store.

    `stands` has every keyframe that ever was; a view is there while its images are.
    """

    def __init__(self, store: KeyframeStore) -> None:
        self.store = store
        self.stands: dict[int, Stand] = {}

    def add(self, view: View) -> None:
        self.store.put(KeyframeImages.of(view))
        self[view.keyframe] = view

    def is_readable(self, keyframe: int) -> bool:
        return self.store.get(keyframe) is not None

    def __getitem__(self, keyframe: int) -> View:
        """Raises KeyError when its images were forgotten or cannot be read."""
        images, stand = self.store.get(keyframe), self.stands[keyframe]
        if images is None:
            raise KeyError(keyframe)
        return images.view(stand.T_map_camera, stand.exposure)

    def __setitem__(self, keyframe: int, view: View) -> None:
        """Take over its pose and its exposure."""
        self.stands[keyframe] = Stand(view.camera, view.T_map_camera, view.exposure)

    def move(self, T_map_camera: Mapping[int, np.ndarray]) -> None:
        """Put keyframes elsewhere."""
        for keyframe, T in T_map_camera.items():
            self.stands[keyframe] = replace(self.stands[keyframe], T_map_camera=T)

    def snapshot(self) -> dict[str, Any]:
        stands = self.stands.values()
        return {
            "keyframes": list(self.stands),
            "cameras": [
                (c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (s.camera for s in stands)
            ],
            "T_map_camera": np.array([s.T_map_camera for s in stands]).reshape(-1, 4, 4),
            "exposures": np.array([s.exposure.matrix for s in stands]).reshape(-1, 2, 3),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Become what `state` is the snapshot of; images of later keyframes are dropped."""
        each = zip(state["cameras"], state["T_map_camera"], state["exposures"], strict=True)
        stands = [Stand(Camera(*c), T, Exposure.of(matrix)) for c, T, matrix in each]
        self.stands = dict(zip(state["keyframes"], stands, strict=True))
        self.store.keep_only(self.stands)
