"""The synthetic room as a map, and points on its true surface."""

from dataclasses import dataclass

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.gaussians import DensificationConfig, GaussianMap, densify
from ldo_service.geometry import se3
from ldo_service.volumes import Viewpoint

KEYFRAMES = range(0, 120, 15)
# what is judged here is made from the map, not the map
FINE = DensificationConfig(max_contrast=0.2)


@dataclass(frozen=True)
class Mapped:
    rows: np.ndarray
    viewpoints: list[Viewpoint]
    frames: range  # of the room, one for each viewpoint


@pytest.fixture(scope="package")
def mapped(room: Sequence) -> Mapped:
    """Gaussians inserted from eight frames at their true poses; the map is the world."""
    T_world_camera, gaussians = room.truth().T_world_camera, GaussianMap()
    for keyframe, index in enumerate(KEYFRAMES):
        densify(gaussians, room[index], T_world_camera[index], keyframe, FINE)
    viewpoints = [Viewpoint(room.camera, T_world_camera[index]) for index in KEYFRAMES]
    return Mapped(gaussians.rows, viewpoints, KEYFRAMES)


@pytest.fixture(scope="package")
def p_true(room: Sequence) -> np.ndarray:
    """Points [P, 3] that rays cast from every fifth pose meet, about a centimetre apart."""
    T_world_camera = room.truth().T_world_camera
    points = [
        se3.transform(T_world_camera[i], room.camera.backproject(room[i].depth_m).reshape(-1, 3))
        for i in range(0, 120, 5)
    ]
    return np.concatenate(points)
