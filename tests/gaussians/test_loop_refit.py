"""Loop refit: pending iterations on a map stub that counts them."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from ldo_service.gaussians.loop_refit import LoopRefit, LoopRefitConfig, displaced_mask
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.geometry.point_records import PoseTable

CONFIG = LoopRefitConfig(
    min_motion_m=0.01,
    min_motion_rad=0.01,
    deduplicated_per_keyframe=0,
    deduplicated_at_end=0,
    deduplication_iterations=0,
    iterations=4,
    iterations_per_keyframe=6,
)


class MapStub:
    """Map stub of five keyframes; some of them see offloaded Gaussians."""

    def __init__(self, offloaded: set[int]) -> None:
        poses = PoseTable()
        for keyframe in range(5):
            poses[keyframe] = np.eye(4)
        self.views = SimpleNamespace(
            poses=poses, cameras=dict.fromkeys(range(5)), store=set(range(5))
        )
        self.offloaded = offloaded
        self.iterations: list[int] = []

    def is_resident(self, keyframe: int) -> bool:
        return keyframe not in self.offloaded

    def refine(self, iterations: int, *_: Any, **__: Any) -> int:
        self.iterations.append(iterations)
        return iterations


def refit_after_correction(map_: MapStub) -> LoopRefit:
    """Return the refit after a correction that moves keyframes 3 and 4 against the first."""
    poses, refit = KeyframePoses(), LoopRefit(map_, CONFIG)  # type: ignore[arg-type]
    for keyframe in range(5):
        correction = se3.exp(np.array([0, 0, 0, 0.1 * (keyframe >= 3), 0, 0]))
        poses.add(keyframe, None, np.eye(4), correction)
    refit.mark_moved(poses)
    return refit


def test_pending_iterations_are_run_once() -> None:
    map_ = MapStub(offloaded=set())
    refit = refit_after_correction(map_)
    for _ in range(4):
        refit.with_keyframe(is_behind=False)
    assert map_.iterations == [6, 2]
    assert refit.pending_iterations == 0


def test_iterations_of_offloaded_keyframes_stay_pending() -> None:
    map_ = MapStub(offloaded={3, 4})
    refit = refit_after_correction(map_)
    refit.with_keyframe(is_behind=False)
    assert map_.iterations == []
    assert refit.pending_iterations == 8
    map_.offloaded = {4}
    for _ in range(3):
        refit.with_keyframe(is_behind=False)
    assert map_.iterations == [4]
    assert refit.pending_iterations == 4


def test_iterations_of_keyframes_whose_images_cannot_be_read_are_dropped() -> None:
    map_ = MapStub(offloaded=set())
    refit = refit_after_correction(map_)
    map_.views.store -= {3, 4}
    refit.while_idle()
    assert map_.iterations == []
    assert refit.pending_iterations == 0


def test_correction_that_bends_a_path_displaces_keyframes_only_where_it_returns() -> None:
    """The camera goes 20 m ahead and back. The correction grows with the path, up to 8 cm."""
    count = 81
    ahead_m = np.r_[np.linspace(0.0, 20.0, 41), np.linspace(20.0, 0.0, 41)[1:]]
    T_before = np.tile(np.eye(4), (count, 1, 1))
    T_before[:, 2, 3] = ahead_m
    T_now = T_before.copy()
    T_now[:, 0, 3] += np.linspace(0.0, 0.08, count)
    is_displaced = displaced_mask(T_now, T_before, LoopRefitConfig())
    assert not is_displaced[:41].any()
    # Near the turning point both passes have moved alike.
    assert not is_displaced[41:44].any()
    assert is_displaced[50:].all()
