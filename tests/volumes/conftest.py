"""Fixtures of the synthetic room: its map and points on its true surface."""

from dataclasses import dataclass

import numpy as np
import pytest

from ldo_service.datasets import Sequence
from ldo_service.gaussians import DensificationConfig, GaussianMap, densify
from ldo_service.geometry import se3
from ldo_service.volumes import Viewpoint

KEYFRAMES = range(0, 120, 15)
# A fine map, because these tests check what is derived from it.
FINE = DensificationConfig(max_contrast=0.2)


@dataclass(frozen=True)
class MappedRoom:
    rows: np.ndarray
    viewpoints: list[Viewpoint]
    frames: range  # Frame index of each viewpoint.


@pytest.fixture(scope="package")
def mapped_room(room: Sequence) -> MappedRoom:
    """Return a map from eight frames at their true poses; the map frame is the world frame."""
    T_world_camera, gaussians = room.truth().T_world_camera, GaussianMap()
    for keyframe, index in enumerate(KEYFRAMES):
        densify(gaussians, room[index], T_world_camera[index], keyframe, FINE)
    viewpoints = [Viewpoint(room.camera, T_world_camera[index]) for index in KEYFRAMES]
    return MappedRoom(gaussians.rows, viewpoints, KEYFRAMES)


@pytest.fixture(scope="package")
def p_true(room: Sequence) -> np.ndarray:
    """Return surface points [P, 3] of rays from every fifth pose, about 1 cm apart."""
    T_world_camera = room.truth().T_world_camera
    points = [
        se3.transform(T_world_camera[i], room.camera.backproject(room[i].depth_m).reshape(-1, 3))
        for i in range(0, 120, 5)
    ]
    return np.concatenate(points)
