"""Tracking of degraded frames: OK poses are correct, and tracking recovers."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.synthetic.path import look_at
from ldo_service.synthetic.room import furnished_room
from ldo_service.synthetic.room_render import Renderer
from ldo_service.synthetic.room_sequence import kinect_depth
from tests.tracking.image_degradation import (
    Degrader,
    covered,
    degradations,
    degraded_frames,
    dropped,
    outcome,
    track,
    track_undisturbed,
    truth_by_frame,
)

FRAMES, START = 60, 20
STEP_NS = 33_333_333
MAX_ERROR_M = 0.10
MAX_RECOVERY_FRAMES = 10
# The steps of the apartment are 25 cm and 10 degrees. After 20 covered frames, 4 frames show what
# was seen from 4 m away. The next 15 show at most 13 % of any earlier frame, and then the room is
# known again.
LATE_RECOVERIES = {
    ("apartment_floor1", "20 frames covered"): 20,
    ("apartment_floor1", "color one frame late"): 5,
}
# Color and depth of the apartment are then 25 cm apart, and LOST is the correct status. After 60
# such frames the camera is in unseen rooms, and a relocalized pose is that of the color image.
SHORT_DURATIONS = {("apartment_floor1", "color one frame late"): 15}
DEGRADATIONS = degradations(START, duration=15)
# Color and depth are then 3 cm apart, and both are correct.
MAX_ERRORS_M = {"color one frame late": MAX_ERROR_M}


@dataclass(frozen=True)
class Walk:
    """A sequence in memory."""

    frames: list[RgbdFrame]
    T_world_camera: list[np.ndarray]

    @property
    def stamps_ns(self) -> np.ndarray:
        return np.array([frame.stamp_ns for frame in self.frames])

    def track(self, degrade: Degrader, degraded: range) -> list:
        return track(
            degraded_frames(self.frames.__getitem__, len(self.frames), degrade, degraded),
            self.stamps_ns,
        )


@pytest.fixture(scope="module")
def walk(room) -> Walk:
    """Return a walk to and fro, so that most of the room stays in view after a degradation."""
    twist = 0.25 * np.array([0.15, 0.5, 0.05, 1.0, 0.2, 0.4])
    poses = [se3.exp(np.sin(2 * np.pi * k / FRAMES) * twist) for k in range(FRAMES)]
    frames = [room.view(T, stamp_ns=k * STEP_NS, index=k) for k, T in enumerate(poses)]
    return Walk(frames, poses)


@pytest.mark.parametrize("name", DEGRADATIONS)
def test_ok_poses_are_correct_and_tracking_recovers(walk: Walk, name: str) -> None:
    degrade, degraded = DEGRADATIONS[name]
    steps = walk.track(degrade, degraded)
    result = outcome(steps, degraded, dict(enumerate(walk.T_world_camera)), np.eye(4))
    max_error_m = MAX_ERRORS_M.get(name, MAX_ERROR_M / 5)  # The room has no noise.
    assert result.max_m < max_error_m, result
    assert result.recovered_after is not None, result
    assert result.recovered_after <= MAX_RECOVERY_FRAMES, result
    assert result.ok_percent > 90, result


def test_covered_frames_are_never_ok(walk: Walk) -> None:
    degraded = range(START, START + 5)
    steps = walk.track(covered, degraded)
    assert not any(s.is_ok for s in steps if s.k in degraded)


def test_dropped_frames_are_not_tracked(walk: Walk) -> None:
    degraded = range(START, START + 5)
    assert [s.k for s in walk.track(dropped, degraded)] == [
        k for k in range(FRAMES) if k not in degraded
    ]


@pytest.mark.parametrize(
    "name", ["left half without depth", "impossible depth", "half as bright", "twice as bright"]
)
def test_partial_degradation_keeps_every_frame_ok(walk: Walk, name: str) -> None:
    degrade, degraded = DEGRADATIONS[name]
    steps = walk.track(degrade, degraded)
    assert all(s.is_ok for s in steps)


def test_pure_rotation_is_tracked(room) -> None:
    poses = [se3.exp(np.array([0.0, 0.02 * k, 0, 0, 0, 0])) for k in range(40)]
    turn = Walk([room.view(T, stamp_ns=k * STEP_NS, index=k) for k, T in enumerate(poses)], poses)
    steps = turn.track(dropped, range(0))
    assert all(s.is_ok for s in steps)
    assert max(np.linalg.norm(s.T_odom_camera[:3, 3]) for s in steps) < 0.01


# --- long sequences with noisy and measured depth -------------------------------------------------
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_full_turn_in_a_noisy_room_has_small_errors() -> None:
    camera, renderer = Camera(320, 240, 260.0, 260.0, 159.5, 119.5), Renderer(furnished_room(0))
    frames, poses, eye = [], [], np.array([-0.2, -0.6, 1.4])
    for k, angle_rad in enumerate(np.linspace(0, 2 * np.pi, 181)):
        T = look_at(eye, eye + np.array([np.sin(angle_rad), np.cos(angle_rad), -0.3]))
        exact = renderer.render(camera, T)
        depth_m = kinect_depth(exact.depth_m, np.random.default_rng(k)).astype(np.float32)
        frames.append(RgbdFrame(exact.color, depth_m, camera, k * STEP_NS, k))
        poses.append(T)
    steps = Walk(frames, poses).track(dropped, range(0))
    result = outcome(steps, range(0), dict(enumerate(poses)), poses[0])
    assert result.max_m < MAX_ERROR_M, result
    assert result.ok_percent > 95, result


@pytest.fixture(scope="module", params=["tum/kitchen", "replica/apartment_floor1"])
def real_sequence(request: pytest.FixtureRequest, data: Path) -> tuple[Sequence, int, Callable]:
    """Return a real sequence, its number of frames, and a function that evaluates steps."""
    sequence = open_sequence(str(data / request.param))
    T_true = truth_by_frame(sequence)
    count = min(300, len(sequence))
    _, T_true_odom = track_undisturbed(sequence, count, T_true)
    return sequence, count, partial(outcome, T_true=T_true, T_true_odom=T_true_odom)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", degradations(0))
def test_degraded_real_sequences_have_small_errors_and_recover(
    real_sequence: tuple[Sequence, int, Callable], name: str
) -> None:
    sequence, count, evaluate = real_sequence
    degrade, degraded = degradations(100, SHORT_DURATIONS.get((sequence.name, name), 60))[name]
    steps = track(
        degraded_frames(sequence.__getitem__, count, degrade, degraded), sequence.stamps_ns
    )
    result = evaluate(steps, degraded)
    assert result.max_m < MAX_ERROR_M, result
    assert result.recovered_after is not None, result
    assert result.recovered_after <= LATE_RECOVERIES.get(
        (sequence.name, name), MAX_RECOVERY_FRAMES
    ), result
