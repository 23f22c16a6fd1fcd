"""The poses of phones, and odometry in bags, are offered as odometry and never as ground truth."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ldo_service.datasets import Cached, Sequence, SequenceOptions, open_sequence
from ldo_service.errors import DataError
from ldo_service.geometry import se3
from ldo_service.geometry.sequence import OdometryAsTruth
from tests.cameras.ros import STORE, header

from .bags import FRAME, KINDS, TF, entries_of, write_bag
from .recordings import record3d_poses, small_frames, write_nerfstudio, write_r3d, write_stray

FRAMES = small_frames(4)
MOTION = np.array([0.1, -0.2, 0.3, 0.02, 0.01, -0.03])
POSES = np.array([se3.exp(k * MOTION) for k in range(4)])
WRITERS: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "Stray Scanner": lambda path, T: write_stray(path, FRAMES, (32, 24), T_world_camera=T),
    "Record3D": lambda path, T: write_r3d(
        path.with_suffix(".r3d"), FRAMES, (32, 24), poses=record3d_poses(T)
    ),
    "nerfstudio": lambda path, T: write_nerfstudio(path, FRAMES, (32, 24), T),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_poses_of_a_phone_are_odometry_with_the_axes_of_this_project(
    tmp_path: Path, write: Callable[[Path, np.ndarray], Path]
) -> None:
    sequence = open_sequence(str(write(tmp_path / "desk", POSES)))
    odometry = sequence.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.T_world_camera, POSES, atol=1e-12)
    np.testing.assert_allclose(odometry.stamps_s, sequence.stamps_ns * 1e-9, atol=1e-9)
    assert sequence.truth() is None
    for wrapped in (OdometryAsTruth(sequence).truth(), Cached(sequence).odometry()):
        assert wrapped is not None
        np.testing.assert_array_equal(wrapped.T_world_camera, odometry.T_world_camera)


def test_frame_without_a_valid_pose_has_no_odometry(tmp_path: Path) -> None:
    folder = write_stray(tmp_path / "desk", FRAMES, (32, 24), T_world_camera=POSES)
    path = folder / "odometry.csv"
    lines = path.read_text().splitlines()
    lines[2] = ",".join(lines[2].split(",")[:2])  # The line ends after stamp and number.
    lines[3] = ",".join(
        [*lines[3].split(",")[:5], *["0", "0", "0", "0"]]
    )  # The quaternion is zero.
    path.write_text("\n".join(lines))
    odometry = open_sequence(str(folder)).odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.T_world_camera, POSES[[0, 3]], atol=1e-12)


@pytest.mark.parametrize("poses", [None, [], "x", [[0, 0]] * 4, [[0] * 7] * 4, [["a"] * 7] * 4])
def test_recording_without_poses_has_no_odometry(tmp_path: Path, poses: object) -> None:
    path = write_r3d(tmp_path / "a.r3d", FRAMES, (32, 24), poses=poses)
    assert open_sequence(str(path)).odometry() is None


# --- bags -----------------------------------------------------------------------------------------
T_BASE_CAMERA = se3.exp(np.array([0.3, -1.2, 0.4, 0.1, 0.2, 0.3]))
BASE = "base_link"


def odometry_message(stamp_ns: int, T_odom_base: np.ndarray) -> Any:
    """Return a nav_msgs/Odometry."""
    types = STORE.types
    w, x, y, z = map(float, se3.quaternion(T_odom_base[:3, :3]))
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*map(float, T_odom_base[:3, 3])),
        types["geometry_msgs/msg/Quaternion"](x, y, z, w),
    )
    vector = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    twist = types["geometry_msgs/msg/Twist"](vector, vector)
    return types["nav_msgs/msg/Odometry"](
        header(stamp_ns, "odom"),
        BASE,
        types["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
        types["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
    )


def mount_message() -> Any:
    """Return the message of /tf_static with the camera on the base."""
    types = STORE.types
    w, x, y, z = map(float, se3.quaternion(T_BASE_CAMERA[:3, :3]))
    transform = types["geometry_msgs/msg/Transform"](
        types["geometry_msgs/msg/Vector3"](*map(float, T_BASE_CAMERA[:3, 3])),
        types["geometry_msgs/msg/Quaternion"](x, y, z, w),
    )
    stamped = types["geometry_msgs/msg/TransformStamped"](header(0, BASE), FRAME, transform)
    return types[TF]([stamped])


def write_odometry_bag(
    folder: Path, kind: str, room: Sequence, topics: tuple[str, ...] = ("/odom",), mounts: int = 1
) -> Path:
    """Write a bag with four frames, and odometry at their stamps on each topic."""
    entries = [(1, "/tf_static", mount_message())] * mounts
    entries += list(entries_of(room, range(4)))
    for topic in topics:
        for k, T_odom_camera in enumerate(POSES):
            stamp_ns = int(room.stamps_ns[k])
            message = odometry_message(stamp_ns, T_odom_camera @ se3.inverse(T_BASE_CAMERA))
            entries.append((stamp_ns + 1, topic, message))
    return write_bag(folder, kind, entries)


@pytest.mark.parametrize("kind", KINDS)
def test_odometry_of_a_base_is_moved_to_the_camera(
    tmp_path: Path, room: Sequence, kind: str
) -> None:
    sequence = open_sequence(str(write_odometry_bag(tmp_path, kind, room)))
    odometry = sequence.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.T_world_camera, POSES, atol=1e-9)
    np.testing.assert_allclose(odometry.stamps_s, room.stamps_ns[:4] * 1e-9, atol=1e-9)
    assert sequence.truth() is None


def test_base_that_is_not_connected_with_the_camera_is_named(
    tmp_path: Path, room: Sequence
) -> None:
    sequence = open_sequence(str(write_odometry_bag(tmp_path, "mcap", room, mounts=0)))
    with pytest.raises(DataError, match=r"/odom has poses of the frame 'base_link'.*/tf_static"):
        sequence.odometry()


def test_one_of_several_odometries_is_chosen_by_its_topic(
    tmp_path: Path, room: Sequence, caplog: pytest.LogCaptureFixture
) -> None:
    path = str(write_odometry_bag(tmp_path, "mcap", room, ("/odom", "/wheels")))
    assert open_sequence(path).odometry() is None
    assert "--topic odometry=/odom" in caplog.text
    for topic in ("/odom", "/wheels"):
        sequence = open_sequence(path, SequenceOptions(topics={"odometry": topic}))
        assert sequence.odometry() is not None
    with pytest.raises(DataError, match=r"odometry=/tf does not name .*: /odom, /wheels"):
        open_sequence(path, SequenceOptions(topics={"odometry": "/tf"}))


def test_bag_without_odometry_has_none(tmp_path: Path, room: Sequence) -> None:
    path = write_bag(tmp_path, "mcap", entries_of(room, range(2)))
    assert open_sequence(str(path)).odometry() is None
