"""What corrections leave to do is paid off where it can be; the map is a stand-in that counts."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from ldo_service.gaussians.loop_refit import LoopRefit, LoopRefitConfig
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.geometry.point_records import PoseTable

CONFIG = LoopRefitConfig(
    mending_min_m=0.01,
    mending_min_rad=0.01,
    mended_keyframes=0,
    mended_at_end=0,
    mending_iterations=0,
    due_iterations=4,
    paid_iterations=6,
)


class Map:
    """Five keyframes with images; some see what sleeps."""

    def __init__(self, asleep: set[int]) -> None:
        poses = PoseTable()
        for keyframe in range(5):
            poses[keyframe] = np.eye(4)
        self.views = SimpleNamespace(poses=poses, cameras=dict.fromkeys(range(5)))
        self.asleep = asleep
        self.iterations: list[int] = []

    def is_resident(self, keyframe: int) -> bool:
        return keyframe not in self.asleep

    def refine(self, iterations: int, *_: Any, **__: Any) -> int:
        self.iterations.append(iterations)
        return iterations


def torn(map_: Map) -> LoopRefit:
    """By a correction that moves keyframes 3 and 4 against the first."""
    poses, repair = KeyframePoses(), LoopRefit(map_, CONFIG)  # type: ignore[arg-type]
    for keyframe in range(5):
        aside = se3.exp(np.array([0, 0, 0, 0.1 * (keyframe >= 3), 0, 0]))
        poses.add(keyframe, None, np.eye(4), aside)
    repair.mark_moved(poses)
    return repair


def test_what_is_due_is_paid_and_no_more() -> None:
    map_ = Map(asleep=set())
    repair = torn(map_)
    for _ in range(4):
        repair.with_keyframe(is_behind=False)
    assert map_.iterations == [6, 2]
    assert repair.pending_iterations == 0


def test_what_is_due_where_all_sleeps_waits_and_costs_nothing() -> None:
    map_ = Map(asleep={3, 4})
    repair = torn(map_)
    repair.with_keyframe(is_behind=False)
    assert map_.iterations == []
    assert repair.pending_iterations == 8
    map_.asleep = {4}
    for _ in range(3):
        repair.with_keyframe(is_behind=False)
    assert map_.iterations == [4]
    assert repair.pending_iterations == 4
