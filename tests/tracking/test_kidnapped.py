"""A camera that is suddenly elsewhere and later back: `slow`, on long sequences."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.tracking import Odometry, OdometryConfig, TrackingResult, TrackingStatus
from ldo_service.tracking.keyframes import KeyframeConfig
from ldo_service.tracking.submaps import SubmapConfig

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def followed(frames: Iterable[RgbdFrame], patience_s: float = 0) -> list[TrackingResult]:
    """`patience_s`: how long it is LOST until a new submap begins; 0: none does."""
    submaps = SubmapConfig(begin_after_s=patience_s)
    config = OdometryConfig(submaps=submaps, keyframes=KeyframeConfig(supporting=2.0))
    odometry = Odometry(config)
    return [odometry.process(frame) for frame in frames]


def distances_m(
    results: Sequence[TrackingResult], T_odom_camera: Iterable[np.ndarray]
) -> np.ndarray:
    pairs = zip(results, T_odom_camera, strict=True)
    return np.array([np.linalg.norm(r.T_odom_camera[:3, 3] - T[:3, 3]) for r, T in pairs])


def assert_found(back: Sequence[TrackingResult], distances: np.ndarray) -> None:
    """Within 3 cm of the truth from the tenth frame on, and never wrong where it is not LOST."""
    known = np.array([r.status is not TrackingStatus.LOST for r in back])
    assert known[10:].all(), [str(r.status) for r in back]
    assert distances[known].max() < 0.03, distances.round(3)


@pytest.mark.parametrize("away", [range(60), range(150, 210)])
def test_kitchen_after_a_visit_to_an_apartment(data: Path, away: range) -> None:
    """Judged by the track that was not interrupted: the truth itself errs by 3 cm."""
    kitchen = open_sequence(str(data / "tum/kitchen"))
    apartment = open_sequence(str(data / "replica/apartment_floor1"))
    before, after = [kitchen[k] for k in range(201)], [kitchen[k] for k in range(201, 240)]
    undisturbed = followed([*before, *after])[201:]
    results = followed([*before, *(apartment[k] for k in away), *after])
    gone, back = results[201 : 201 + len(away)], results[201 + len(away) :]
    assert {r.status for r in gone} == {TrackingStatus.LOST}
    assert_found(back, distances_m(back, [r.T_odom_camera for r in undisturbed]))


def test_the_apartment_becomes_a_submap_of_its_own_and_the_kitchen_stays(data: Path) -> None:
    kitchen = open_sequence(str(data / "tum/kitchen"))
    apartment = open_sequence(str(data / "replica/apartment_floor1"))
    frames = [kitchen[k] for k in range(140, 240)]
    undisturbed = followed(frames)[60:]
    visit = [apartment[k] for k in range(100)]
    results = followed([*frames[:60], *visit, *frames[60:]], patience_s=0.63)
    gone, back = results[60:160], results[160:]
    assert {r.status for r in gone[:19]} == {TrackingStatus.LOST}
    apart = [r for r in gone if r.submap > 0]
    assert sum(r.status is TrackingStatus.OK for r in apart) > 40
    assert all(r.status is TrackingStatus.LOST for r in gone if r.submap == 0)
    assert not any(r.keyframe and r.keyframe.submap_measurement for r in results), (
        "two places that do not meet"
    )
    known = [r for r in back if r.status is not TrackingStatus.LOST]
    assert {r.submap for r in known[3:]} == {0}
    assert_found(back, distances_m(back, [r.T_odom_camera for r in undisturbed]))


def walked(flat, *stretches: range) -> list[list[TrackingResult]]:
    """Results of each stretch of one track."""
    results = followed(flat[k] for stretch in stretches for k in stretch)
    ends = np.cumsum([len(stretch) for stretch in stretches])
    return [results[end - len(s) : end] for s, end in zip(stretches, ends, strict=True)]


def errors_m(flat, results: Sequence[TrackingResult], frames: range, start: int) -> np.ndarray:
    """Against exact truth, in the frame of the first pose of the track, frame `start`."""
    T_world = flat.truth().T_world_camera
    return distances_m(results, se3.inverse(T_world[start]) @ T_world[frames.start : frames.stop])


def test_flat_after_a_jump_to_a_room_never_seen() -> None:
    flat = open_sequence("synthetic:flat")
    _, gone, back = walked(flat, range(200, 300), range(20, 60), range(300, 330))
    assert {r.status for r in gone} == {TrackingStatus.LOST}
    assert_found(back, errors_m(flat, back, range(300, 330), start=200))


def test_flat_after_a_jump_to_a_room_seen_before() -> None:
    """There the camera is found; what is found is right, and what is not found is LOST."""
    flat = open_sequence("synthetic:flat")
    _, gone, back = walked(flat, range(20, 120), range(400, 440), range(120, 150))
    known = np.array([r.status is not TrackingStatus.LOST for r in gone])
    assert known.any()
    assert errors_m(flat, gone, range(400, 440), start=20)[known].max() < 0.03
    assert_found(back, errors_m(flat, back, range(120, 150), start=20))
