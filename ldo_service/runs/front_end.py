"""Recorded front end of a run, which other runs can use instead of their own front end.

The front end consists of the actors that process every frame: frame source, tracker and detector. A
run can replace them by their recorded outputs. Each output is replayed at its original tick of the
logical clock. With the same settings, the other actors then reproduce the recorded run bit for bit.
With different settings of the other actors, the odometry is still the same, so differences between
the runs come from these settings alone.

The recorded tracker received the pose-graph corrections of the recorded run. Its published poses
and reused keyframes therefore stay the same, even if the new run corrects keyframes differently.
"""

import json
import logging
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import msgspec
import numpy as np

from ldo_service import versions
from ldo_service.actors.detector import Detector
from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.tracker import Tracker
from ldo_service.config import Config, recording_parameters
from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry.sequence import Sequence
from ldo_service.recordings.mcap_file import (
    ABOUT,
    McapIndex,
    MessageLocation,
    RecordingFile,
    require_version,
)
from ldo_service.schemas import Message, decode
from ldo_service.schemas.topics import (
    DETECTION_BOXES,
    KEYFRAME_MEASUREMENTS,
    KEYFRAME_NEW,
    POSE_TRACKED,
)

from .source import Selection

log = logging.getLogger(__name__)

FRONT_END = "front_end.mcap"  # File in the folder of a run.
ACTORS = frozenset({FrameSource.name, Tracker.name, Detector.name})
TOPICS = {
    topic.message: topic
    for topic in (POSE_TRACKED, KEYFRAME_NEW, KEYFRAME_MEASUREMENTS, DETECTION_BOXES)
}
MESSAGES = {topic.name: topic.message for topic in TOPICS.values()}
DETECTOR_LATENCY = "offline.latency_frames.detector"


class FrontEndRecord:
    """Recorder of the front end of a run, used as a context manager.

    An incomplete recording cannot be used. Therefore the file is deleted if the run fails, if the
    recording exceeds `recording.max_gb`, or if less than `recording.min_free_gb` is free.
    """

    def __init__(
        self, folder: Path, config: Config, sequence: Sequence, selection: Selection
    ) -> None:
        about = {
            "source": sequence.name,
            "stride": str(selection.stride),
            "frames": str(len(selection.indices(sequence))),
            "settings": json.dumps(front_end_settings(config)),
            "ldo": versions()["ldo-slam"],
        }
        self._file = RecordingFile(folder / FRONT_END, about, recording_parameters(config))

    def observe(self, message: Message, tick: int) -> None:
        """Record a message if it is an output of the front end; ignore other messages.

        Args:
            message: Output of an actor.
            tick: Tick of the logical clock at which it was produced.
        """
        topic = TOPICS.get(type(message))
        if topic is None:
            return
        body = msgspec.msgpack.encode(message)
        self._file.add(topic.name, topic.message, body, tick, message.stamp_ns)
        if self._file.is_open and self._file.is_over_limit():
            log.error(
                "front end: %s exceeds recording.max_gb, or less than recording.min_free_gb of the "
                "disk is free. The file is deleted, and the run continues without it. Raise "
                "recording.max_gb or free some disk space.",
                self._file.path,
            )
            self._drop()

    def __enter__(self) -> "FrontEndRecord":
        return self

    def __exit__(self, error: type[BaseException] | None, *_rest: object) -> None:
        self._file.close()
        if error:
            self._drop()

    def _drop(self) -> None:
        self._file.abandon()
        with suppress(OSError):
            self._file.path.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class FrontEnd:
    """Recorded front end of a finished run, for a run over the same frames.

    Attributes:
        rejected: Number of selected frames for which the recording has no pose.
    """

    rejected: int
    _index: McapIndex

    @classmethod
    def open(
        cls, run: Path, config: Config, sequence: Sequence, selection: Selection
    ) -> "FrontEnd":
        """Open the recorded front end of a run.

        Args:
            run: Folder of the recorded run.
            config: Configuration of the new run.
            sequence: Sequence of the new run.
            selection: Selected frames of the new run.

        Raises:
            DataError: There is no recording, it is incomplete, or it has different frames.
            ConfigError: A setting of the front end differs from the recorded one.
        """
        path = run.expanduser() / FRONT_END
        if not path.is_file():
            raise DataError(f"{run} has no {FRONT_END}. Make that run again with --keep-front-end.")
        index = McapIndex(path)
        if not index.is_whole:
            raise DataError(
                f"{path} is not complete because its run was killed or the disk was full. Repeat "
                "that run."
            )
        require_version(index)
        about = index.metadata.get(ABOUT, {})
        _require_settings(path, about, config)
        frames = len(selection.indices(sequence))
        ours = (sequence.name, str(selection.stride), str(frames))
        kept = tuple(about.get(name, "") for name in ("source", "stride", "frames"))
        stamps_ns = np.array([p.stamp_ns for p in index.locations if p.topic == POSE_TRACKED.name])
        if ours != kept or not np.isin(stamps_ns, sequence.stamps_ns).all():
            raise DataError(
                f"{path} has {kept[2]} frames of {kept[0]} with stride {kept[1]}; this run has "
                f"{ours[2]} of {ours[0]} with stride {ours[1]}. Source, stamps, --stride and "
                "--max-frames must be the same as in the recorded run."
            )
        return cls(frames - len(stamps_ns), index)

    def __iter__(self) -> Iterator[tuple[Message, ...]]:
        """Yield a tuple of the messages of each tick of the logical clock.

        The tuple is empty for a tick without messages. The iteration ends at the last message.
        """
        tick = 0
        for number, locations in groupby(self._index.locations, lambda place: place.number):
            while tick < number:
                yield ()
                tick += 1
            yield self._messages(list(locations))
            tick += 1

    def _messages(self, locations: list[MessageLocation]) -> tuple[Message, ...]:
        try:
            return tuple(decode(self._index.body(p), MESSAGES[p.topic]) for p in locations)
        except (msgspec.DecodeError, LookupError, OSError) as error:
            raise DataError(
                f"{self._index.path}: the messages of tick {locations[0].number} cannot be read: "
                f"{error}. Repeat the run that recorded the file."
            ) from error


def front_end_settings(config: Config) -> dict[str, object]:
    """Return the settings that affect the front end, by their dotted names."""
    tree = msgspec.to_builtins(config)
    sections = {name: tree[name] for name in (*sorted(ACTORS), "inference", "dataset")}
    return {**dict(_leaves("", sections)), DETECTOR_LATENCY: config.offline.latency_frames.detector}


def _leaves(prefix: str, tree: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(f"{prefix}{key}.", value)
        else:
            yield f"{prefix}{key}", value


def _require_settings(path: Path, about: Mapping[str, str], config: Config) -> None:
    try:
        was = dict(json.loads(about.get("settings", "")))
    except (ValueError, TypeError) as error:
        raise DataError(
            f"{path} does not contain the settings of the run that recorded it ({error}). Repeat "
            "that run."
        ) from error
    configured = json.loads(json.dumps(front_end_settings(config)))
    if was.keys() != configured.keys():
        made_by, ours = about.get("ldo", "an unknown version"), versions()["ldo-slam"]
        raise DataError(
            f"{path} was recorded by LDO-SLAM {made_by}, whose settings differ from those of "
            f"this version, {ours}. Repeat the recorded run with this version."
        )
    for name, value in configured.items():
        if was[name] != value:
            raise ConfigError(
                f"{name}={value} must be {was[name]}, the value of the run that recorded {path}. "
                "With --reuse-front-end, the front end does not run again. Set the recorded value, "
                "or remove --reuse-front-end."
            )
