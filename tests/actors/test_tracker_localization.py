"""Localization of a camera in the map of a finished run."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.actors.tracker import Tracker, TrackerConfig
from ldo_service.conversions.poses import pose_from_message
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import se3
from ldo_service.schemas import TrackedPose
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.tracking.keyframe_database import DATABASE_FILE
from ldo_service.tracking.localizer import load_keyframe_database


def localizing_tracker(finished_run: Path) -> Tracker:
    return Tracker(TrackerConfig(localize=str(finished_run)))


def test_poses_are_in_the_frame_of_the_map(room: Sequence, finished_run: Path, frames) -> None:
    """The map has frames 0 to 15; the camera starts at frame 12 and leaves the mapped area."""
    tracker = localizing_tracker(finished_run)
    made = [out for frame in frames[12:30] for out in tracker.handle(frame)]
    assert all(isinstance(message, TrackedPose) for message in made), "no keyframe is made"
    assert [pose.status for pose in made[:2]] == ["LOST", "OK"]
    truth = room.truth()
    assert truth is not None
    T_map_world = se3.inverse(truth.T_world_camera[0])
    for pose in made[1:]:
        assert pose.status == "OK"
        T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
        T_true = T_map_world @ truth.T_world_camera[pose.frame]
        np.testing.assert_allclose(T_map_camera[:3, 3], T_true[:3, 3], atol=0.01)


@pytest.mark.parametrize("split", [1, 8])
def test_restored_tracker_continues_bitwise_equal(finished_run: Path, frames, split: int) -> None:
    first, second = localizing_tracker(finished_run), localizing_tracker(finished_run)
    for frame in frames[: split + 1]:
        list(first.handle(frame))
    state = {name: decode_state(encode_state(part)) for name, part in first.snapshot().items()}
    second.restore(state)
    for frame in frames[split + 1 : split + 10]:
        (pose,), (expected,) = second.handle(frame), first.handle(frame)
        assert msgspec.msgpack.encode(pose) == msgspec.msgpack.encode(expected)


def test_state_of_mapping_and_localizing_trackers_is_not_interchangeable(
    finished_run: Path, frames
) -> None:
    mapping = Tracker()
    list(mapping.handle(frames[0]))
    tracker = localizing_tracker(finished_run)
    list(tracker.handle(frames[0]))
    with pytest.raises(ConfigError, match="--state"):
        localizing_tracker(finished_run).restore(mapping.snapshot())
    with pytest.raises(ConfigError, match=str(finished_run)):
        Tracker().restore(tracker.snapshot())


def test_a_folder_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no keyframe_database\.msgpack.*ldo run"):
        load_keyframe_database(tmp_path)


@pytest.mark.parametrize("body", [b"", b"nonsense", encode_state({"places": [{"id": 1}]})])
def test_invalid_keyframe_database_is_refused(tmp_path: Path, body: bytes) -> None:
    (tmp_path / DATABASE_FILE).write_bytes(body)
    with pytest.raises(DataError, match="is not a valid keyframe database"):
        load_keyframe_database(tmp_path)


def test_keyframe_database_without_records_is_refused(tmp_path: Path) -> None:
    (tmp_path / DATABASE_FILE).write_bytes(encode_state({"places": []}))
    with pytest.raises(DataError, match="contains no keyframe"):
        load_keyframe_database(tmp_path)
