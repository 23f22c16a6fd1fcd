"""Check of walks with a simulated camera that is held in the hand."""

import numpy as np

from ldo_service.geometry import Trajectory
from ldo_service.synthetic.flat.__main__ import motion
from ldo_service.synthetic.flat.scene import Flat
from ldo_service.synthetic.solids import vector


def require_hand_held_walk(truth: Trajectory, scene: Flat) -> None:
    """Check that the camera moves as in a hand, and stays 0.2 m away from all solids."""
    T = truth.T_world_camera
    moved_by = motion(T)
    assert np.percentile(moved_by.speeds_m_s, 98) < 1.6
    assert moved_by.turns_deg_s.max() < 110
    eyes = vector(T[:, :3, 3].T)
    solids = [panel.solid for panel in scene.panels]
    for solid in solids + [solid for thing in scene.things for solid in thing.solids]:
        local = np.abs(np.stack(solid.point_to_local(eyes)))
        reach = 1 + 0.4 / np.array(solid.size_m)[:, None]
        assert not (local < reach).all(axis=0).any(), solid
