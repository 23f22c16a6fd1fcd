"""The renderer's poses become measurements, of old keyframes too, in little memory."""

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
OF_REFERENCE, OF_WINDOW = matrix6_to_message(3.0 * np.eye(6)), matrix6_to_message(2.0 * np.eye(6))


def keyframe(k: int) -> Keyframe:
    """Measured from the one before, and from the one before that."""
    window = [
        MeasuredPose(
            reference=reference,
            keyframe=k,
            T_reference_keyframe=pose_to_message(STEP @ STEP),
            information=OF_WINDOW,
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
        information=OF_REFERENCE,
        T_odom_keyframe=pose_to_message(np.eye(4)),
        overlap=1.0,
        window_measurements=tuple(window),
    )


def followed(count: int) -> tuple[KeyframePoses, RelativeMeasurements]:
    poses = KeyframePoses()
    links = RelativeMeasurements(poses, RECENT)
    for k in range(count):
        poses.add(k, k - 1 if k else None, STEP if k else np.eye(4), np.eye(4))
        links.add(keyframe(k))
    return poses, links


def told(links: RelativeMeasurements, moved: dict[int, np.ndarray]) -> Iterator[tuple]:
    refinement = links.refined(moved, 0)
    assert refinement is not None
    return ((p.keyframe, p.reference, p.information) for p in refinement.poses)


def test_of_a_recent_keyframe_every_measurement_is_taken_anew() -> None:
    poses, links = followed(10)
    assert list(told(links, {8: poses[8]})) == [
        (8, 7, OF_REFERENCE),
        (8, 6, OF_WINDOW),
        (9, 8, OF_REFERENCE),
    ]


def test_of_an_old_one_those_along_the_path_are() -> None:
    poses, links = followed(10)
    assert list(told(links, {3: poses[3]})) == [(3, 2, OF_REFERENCE), (4, 3, OF_REFERENCE)]


@pytest.mark.parametrize("moved", [3, 8])
def test_a_restored_one_says_the_same(moved: int) -> None:
    poses, links = followed(10)
    links.refined({7: poses[7]}, 0)
    twin = RelativeMeasurements(poses, RECENT)
    twin.restore(links.snapshot())
    assert twin.acknowledged(0) == links.acknowledged(0) == {7}
    T_map = {moved: poses[moved] @ STEP}
    said = [one.refined(T_map, 0) for one in (links, twin)]
    assert said[0] is not None
    assert said[0].number == 2
    assert msgspec.msgpack.encode(said[0]) == msgspec.msgpack.encode(said[1])


def test_an_old_keyframe_takes_some_hundred_bytes() -> None:
    _, links = followed(2000)
    assert len(links._recent) == RECENT
    assert links._older._room.nbytes < 130 * 2000
