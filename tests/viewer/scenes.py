"""Scenes and sources that tests set by hand."""

from typing import get_args

import msgspec
import numpy as np

from ldo_service.gaussians.rows import aligned_rows
from ldo_service.geometry import Camera
from ldo_service.schemas import MapObject, MapObjects, ObjectView, Pose
from ldo_service.viewer.scene import Layer, ObjectBox, Scene
from tests.schemas.examples import EXAMPLES

RED, GREEN = (0.9, 0.05, 0.05), (0.05, 0.9, 0.05)
EVERY_LAYER: set[Layer] = set(get_args(Layer))


class ManualSource:
    """Source of a scene that reports the layers that a test marks as changed."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.changed: set[Layer] = set(EVERY_LAYER)

    def update(self, *, is_watched: bool = True) -> set[Layer]:  # noqa: ARG002
        changed, self.changed = self.changed, set()
        return changed


def wall(color: tuple[float, float, float], half_m: float = 3.0, z_m: float = 3.0) -> np.ndarray:
    """Return rows [N, 16] of an opaque wall in front of the first camera."""
    x, y = np.meshgrid(*2 * [np.arange(-half_m, half_m, 0.1)])
    rows = aligned_rows(x.size)
    rows[:, 0], rows[:, 1], rows[:, 2] = x.ravel(), y.ravel(), z_m
    rows[:, 3:6] = np.log([0.1, 0.1, 0.01])
    rows[:, 6] = 1
    rows[:, 10] = 6
    rows[:, 11:14] = color
    return rows


def chair(x_m: float) -> MapObject:
    """Return a chair that keyframe 1 observes."""
    found = EXAMPLES["map_objects"]
    assert isinstance(found, MapObjects)
    return msgspec.structs.replace(
        found.objects[0],
        id=7,
        name="chair",
        distribution=(("chair", 0.9),),
        T_map_object=Pose((x_m, 0.0, 3.0), (1.0, 0.0, 0.0, 0.0)),
        size=(0.5, 0.5, 0.5),
        views=(ObjectView(keyframe=1, box_px=(10.0, 10.0, 30.0, 30.0)),),
    )


def scene_of(rows: np.ndarray, *objects: MapObject) -> Scene:
    """Return the scene of a camera that moved one meter to the right, with three keyframes."""
    path = np.linspace([0, 0, 0], [1, 0, 0], 11)
    keyframes = {k: np.eye(4) for k in range(3)}
    for k, T in keyframes.items():
        T[0, 3] = 0.5 * k
    found = EXAMPLES["map_objects"]
    assert isinstance(found, MapObjects)
    return Scene(
        rows=rows,
        online=path,
        final=path + np.array([0, 0.1, 0]),
        keyframes=keyframes,
        camera=Camera(64, 48, 60.0, 60.0, 31.5, 23.5),
        detections={1: (ObjectBox("chair", (10.0, 10.0, 30.0, 30.0)),)},
        objects=msgspec.structs.replace(found, objects=objects),
        loops=((0, 2),),
        T_map_camera=keyframes[0],
        facts="**all is well**",
    )
