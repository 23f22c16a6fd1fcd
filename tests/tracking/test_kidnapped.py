"""Relocalization after a sudden jump to another place; `slow`, on long sequences."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.tracking import Odometry, OdometryConfig, TrackingResult, TrackingStatus
from ldo_service.tracking.keyframes import KeyframeConfig
from ldo_service.tracking.shutter import ShutterConfig
from ldo_service.tracking.submaps import SubmapConfig

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def track(frames: Iterable[RgbdFrame], begin_after_frames: int = 0) -> list[TrackingResult]:
    """Track frames; 0 `begin_after_frames` starts no submap.

    The kitchen's camera has a rolling shutter, the apartment's has none. The compensation of the
    shutter is off, because the frames of both are tracked as those of one camera.
    """
    config = OdometryConfig(
        submaps=SubmapConfig(begin_after_frames=begin_after_frames),
        keyframes=KeyframeConfig(mapping_only_ratio=2.0),
        shutter=ShutterConfig(is_on=False),
    )
    odometry = Odometry(config)
    return [odometry.process(frame) for frame in frames]


def distances_m(
    results: Sequence[TrackingResult], T_odom_camera: Iterable[np.ndarray]
) -> np.ndarray:
    pairs = zip(results, T_odom_camera, strict=True)
    return np.array([np.linalg.norm(r.T_odom_camera[:3, 3] - T[:3, 3]) for r, T in pairs])


def assert_found(back: Sequence[TrackingResult], distances: np.ndarray) -> None:
    """Assert errors below 3 cm unless LOST, and no LOST frame from the tenth on."""
    is_tracked = np.array([r.status is not TrackingStatus.LOST for r in back])
    assert is_tracked[10:].all(), [str(r.status) for r in back]
    assert distances[is_tracked].max() < 0.03, distances.round(3)


@pytest.mark.parametrize("away", [range(60), range(150, 210)])
def test_kitchen_is_relocalized_after_a_visit_to_an_apartment(data: Path, away: range) -> None:
    """The uninterrupted track is the reference; the ground truth has errors of 3 cm."""
    kitchen = open_sequence(str(data / "tum/kitchen"))
    apartment = open_sequence(str(data / "replica/apartment_floor1"))
    before, after = [kitchen[k] for k in range(201)], [kitchen[k] for k in range(201, 240)]
    undisturbed = track([*before, *after])[201:]
    results = track([*before, *(apartment[k] for k in away), *after])
    elsewhere, back = results[201 : 201 + len(away)], results[201 + len(away) :]
    assert {r.status for r in elsewhere} == {TrackingStatus.LOST}
    assert_found(back, distances_m(back, [r.T_odom_camera for r in undisturbed]))


def test_apartment_starts_a_submap_and_the_kitchen_resumes_the_first(data: Path) -> None:
    kitchen = open_sequence(str(data / "tum/kitchen"))
    apartment = open_sequence(str(data / "replica/apartment_floor1"))
    frames = [kitchen[k] for k in range(140, 240)]
    undisturbed = track(frames)[60:]
    visit = [apartment[k] for k in range(100)]
    results = track([*frames[:60], *visit, *frames[60:]], begin_after_frames=60)
    elsewhere, back = results[60:160], results[160:]
    assert {r.status for r in elsewhere[:19]} == {TrackingStatus.LOST}
    second_submap = [r for r in elsewhere if r.submap > 0]
    assert sum(r.status is TrackingStatus.OK for r in second_submap) > 40
    assert all(r.status is TrackingStatus.LOST for r in elsewhere if r.submap == 0)
    assert not any(r.keyframe and r.keyframe.submap_measurement for r in results), (
        "submaps without overlap must not be merged"
    )
    tracked = [r for r in back if r.status is not TrackingStatus.LOST]
    assert {r.submap for r in tracked[3:]} == {0}
    assert_found(back, distances_m(back, [r.T_odom_camera for r in undisturbed]))


def track_stretches(flat, *stretches: range) -> list[list[TrackingResult]]:
    """Track stretches of frames as one sequence, and return the results of each."""
    results = track(flat[k] for stretch in stretches for k in stretch)
    ends = np.cumsum([len(stretch) for stretch in stretches])
    return [results[end - len(s) : end] for s, end in zip(stretches, ends, strict=True)]


def errors_m(flat, results: Sequence[TrackingResult], frames: range, start: int) -> np.ndarray:
    """Return position errors in the frame of the first pose of the track, frame `start`."""
    T_world = flat.truth().T_world_camera
    return distances_m(results, se3.inverse(T_world[start]) @ T_world[frames.start : frames.stop])


def test_jump_to_an_unseen_room_is_lost_until_the_camera_returns() -> None:
    flat = open_sequence("synthetic:flat")
    _, elsewhere, back = track_stretches(flat, range(200, 300), range(20, 60), range(300, 330))
    assert {r.status for r in elsewhere} == {TrackingStatus.LOST}
    assert_found(back, errors_m(flat, back, range(300, 330), start=200))


def test_jump_to_a_seen_room_is_relocalized_correctly() -> None:
    """Frames in the seen room are either correct or LOST."""
    flat = open_sequence("synthetic:flat")
    _, elsewhere, back = track_stretches(flat, range(20, 120), range(400, 440), range(120, 150))
    is_tracked = np.array([r.status is not TrackingStatus.LOST for r in elsewhere])
    assert is_tracked.any()
    assert errors_m(flat, elsewhere, range(400, 440), start=20)[is_tracked].max() < 0.03
    assert_found(back, errors_m(flat, back, range(120, 150), start=20))
