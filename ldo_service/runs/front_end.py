"""What the front end of a run said, kept to run other back ends on the same poses and keyframes.

The front end is who looks at every frame: frame source, tracker and detector. Given its words
again, each at the tick at which it was heard, the others make what they made in the run that was
kept, to the bit; with other settings of theirs they make what those settings are worth, odometry
being the same. What the tracker knew of the map, by corrections, is that of the kept run: so are
the poses as they were published, and to which keyframes it returned.
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
from ldo_service.schemas.topics import DETECTION_BOXES, KEYFRAME_NEW, POSE_TRACKED

from .source import Selection

log = logging.getLogger(__name__)

FRONT_END = "front_end.mcap"  # in the folder of a run
ACTORS = frozenset({FrameSource.name, Tracker.name, Detector.name})
TOPICS = {topic.message: topic for topic in (POSE_TRACKED, KEYFRAME_NEW, DETECTION_BOXES)}
MESSAGES = {topic.name: topic.message for topic in TOPICS.values()}
DETECTOR_LATENCY = "offline.latency_frames.detector"


class FrontEndRecord:
    """Record of the front end, kept in a context.

    It is removed when the run fails, grows past `recording.max_gb` or fills the disk: it would be
    no front end for other runs.
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
        topic = TOPICS.get(type(message))
        if topic is None:
            return
        body = msgspec.msgpack.encode(message)
        self._file.add(topic.name, topic.message, body, tick, message.stamp_ns)
        if self._file.is_open and self._file.is_over_limit():
            log.error("%s: no room by recording.max_gb and min_free_gb: not kept", self._file.path)
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
    """That of a finished run, for a run over the same frames.

    rejected: of the frames, how many could not be used.
    """

    rejected: int
    _index: McapIndex

    @classmethod
    def open(
        cls, run: Path, config: Config, sequence: Sequence, selection: Selection
    ) -> "FrontEnd":
        """Raises DataError where there is none or not of these frames, ConfigError where a setting
        of it is asked to be another."""
        path = run.expanduser() / FRONT_END
        if not path.is_file():
            raise DataError(
                f"{run} has no {FRONT_END}: `ldo run --keep-front-end` leaves one in its folder."
            )
        index = McapIndex(path)
        if not index.is_whole:
            raise DataError(f"{path} is not whole: its run was killed. Make that run again.")
        require_version(index)
        about = index.metadata.get(ABOUT, {})
        _require_settings(path, about, config)
        frames = len(selection.indices(sequence))
        told = (sequence.name, str(selection.stride), str(frames))
        kept = tuple(about.get(name, "") for name in ("source", "stride", "frames"))
        stamps_ns = np.array([p.stamp_ns for p in index.places if p.topic == POSE_TRACKED.name])
        if told != kept or not np.isin(stamps_ns, sequence.stamps_ns).all():
            raise DataError(
                f"{path} is of {kept[2]} frames of {kept[0]}, every {kept[1]}th; asked for are "
                f"{told[2]} of {told[0]}, every {told[1]}th, at their stamps."
            )
        return cls(frames - len(stamps_ns), index)

    def __iter__(self) -> Iterator[tuple[Message, ...]]:
        """What was heard at each tick, from the first to the last at which anything was."""
        tick = 0
        for number, places in groupby(self._index.places, lambda place: place.number):
            while tick < number:
                yield ()
                tick += 1
            yield self._messages(list(places))
            tick += 1

    def _messages(self, places: list[MessageLocation]) -> tuple[Message, ...]:
        try:
            return tuple(decode(self._index.body(p), MESSAGES[p.topic]) for p in places)
        except (msgspec.DecodeError, LookupError, OSError) as error:
            raise DataError(f"{self._index.path}, frame {places[0].number}: {error}.") from error


def front_end_settings(config: Config) -> dict[str, object]:
    """Those that a front end depends on, by their dotted names."""
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
        raise DataError(f"{path} does not say how it was made: {error}.") from error
    asked = json.loads(json.dumps(front_end_settings(config)))
    if was.keys() != asked.keys():
        made_by, ours = about.get("ldo", "an unknown version"), versions()["ldo-slam"]
        raise DataError(
            f"{path} is of LDO-SLAM {made_by}, which had other settings than this, {ours}. Make "
            "that run again."
        )
    for name, value in asked.items():
        if was[name] != value:
            raise ConfigError(
                f"{name} is {value} and was {was[name]} when {path} was made: the front end does "
                "not run again. Leave it as it was, or leave out --reuse-front-end."
            )
