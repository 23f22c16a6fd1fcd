"""Relative-pose measurements of refined keyframes, with bounded memory."""

from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from ldo_service.conversions.poses import matrix6_to_message, pose_to_message
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.maps.relative_measurements import RelativeMeasurements
from ldo_service.schemas import Array, Keyframe, MeasuredPose
from ldo_service.schemas.frames import CameraModel

RECENT = 4
STEP = se3.exp(np.array([0.01, 0.02, 0.0, 0.1, 0.0, 0.02]))
REFERENCE_INFORMATION = matrix6_to_message(3.0 * np.eye(6))
WINDOW_INFORMATION = matrix6_to_message(2.0 * np.eye(6))


def keyframe(k: int) -> Keyframe:
    """Return a keyframe measured from the previous two."""
    window = [
        MeasuredPose(
            reference=reference,
            keyframe=k,
            T_reference_keyframe=pose_to_message(STEP @ STEP),
            information=WINDOW_INFORMATION,
        )
        for reference in range(max(0, k - 2), k - 1)
    ]
    return Keyframe(
        stamp_ns=k,
        keyframe=k,
        frame=k,
        camera=CameraModel(width=1, height=1, fx=1.0, fy=1.0, cx=0.0, cy=0.0),
        color=Array.of(np.zeros((1, 1, 3), np.uint8)),
        depth_m=Array.of(np.zeros((1, 1), np.float32)),
        reference=k - 1 if k else None,
        T_reference_keyframe=pose_to_message(STEP if k else np.eye(4)),
        information=REFERENCE_INFORMATION,
        T_odom_keyframe=pose_to_message(np.eye(4)),
        overlap=1.0,
        window_measurements=tuple(window),
    )


def measurements_of(count: int) -> tuple[KeyframePoses, RelativeMeasurements]:
    poses = KeyframePoses()
    measurements = RelativeMeasurements(poses, RECENT)
    for k in range(count):
        poses.add(k, k - 1 if k else None, STEP if k else np.eye(4), np.eye(4))
        measurements.add(keyframe(k))
    return poses, measurements


def measured_poses(
    measurements: RelativeMeasurements, moved: dict[int, np.ndarray]
) -> Iterator[tuple]:
    refinement = measurements.refined(moved, 0)
    assert refinement is not None
    return ((p.keyframe, p.reference, p.information) for p in refinement.poses)


def test_all_measurements_of_a_recent_keyframe_are_updated() -> None:
    poses, measurements = measurements_of(10)
    assert list(measured_poses(measurements, {8: poses[8]})) == [
        (8, 7, REFERENCE_INFORMATION),
        (8, 6, WINDOW_INFORMATION),
        (9, 8, REFERENCE_INFORMATION),
    ]


def test_only_path_measurements_of_an_old_keyframe_are_updated() -> None:
    poses, measurements = measurements_of(10)
    assert list(measured_poses(measurements, {3: poses[3]})) == [
        (3, 2, REFERENCE_INFORMATION),
        (4, 3, REFERENCE_INFORMATION),
    ]


@pytest.mark.parametrize("moved", [3, 8])
def test_restored_measurements_give_an_equal_message(moved: int) -> None:
    poses, measurements = measurements_of(10)
    measurements.refined({7: poses[7]}, 0)
    restored = RelativeMeasurements(poses, RECENT)
    restored.restore(measurements.snapshot())
    assert restored.acknowledged(0) == measurements.acknowledged(0) == {7}
    T_refined = {moved: poses[moved] @ STEP}
    refinements = [one.refined(T_refined, 0) for one in (measurements, restored)]
    assert refinements[0] is not None
    assert refinements[0].number == 2
    assert msgspec.msgpack.encode(refinements[0]) == msgspec.msgpack.encode(refinements[1])


def test_old_keyframe_uses_at_most_130_bytes() -> None:
    _, measurements = measurements_of(2000)
    assert len(measurements._recent) == RECENT
    assert measurements._older._room.nbytes < 130 * 2000
