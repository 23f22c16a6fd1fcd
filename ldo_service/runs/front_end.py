"""What the front end of a run said, kept to run other back ends on the same poses and keyframes.

The front end is who looks at every frame and asks nothing of the map: frame source, tracker and
detector. Given its words again, each at the tick at which it was heard, the others make what they
made in the run that was kept, to the bit; with other settings of theirs they make what those
settings are worth, the camera's poses being the same.
"""

import json
import logging
from collections.abc import Iterator
from collections.abc import Sequence as Places
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import msgspec
import numpy as np
import yaml

from ldo_service.actors.detector import Detector
from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.tracker import Tracker
from ldo_service.config import Config, config_of, config_yaml
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError, DataError
from ldo_service.plain_yaml import plain_values
from ldo_service.runtime.mcap_index import McapIndex, Place
from ldo_service.runtime.recording_file import ABOUT, RecordingFile
from ldo_service.schemas import Message, decode
from ldo_service.schemas.topics import DETECTION_BOXES, KEYFRAME_NEW, POSE_TRACKED
from ldo_service.versions import versions

from .source import Selection

log = logging.getLogger(__name__)

FRONT_END = "front_end.mcap"  # in the folder of a run
ACTORS = frozenset({FrameSource.name, Tracker.name, Detector.name})
TOPICS = {topic.message: topic for topic in (POSE_TRACKED, KEYFRAME_NEW, DETECTION_BOXES)}
MESSAGES = {topic.name: topic.message for topic in TOPICS.values()}
DETECTOR_LATENCY = "run.detector_latency_frames"


class FrontEndRecord:
    """Keeps what is heard, in a context. Of a run that fails, grows past `record.max_gb` or fills
    the disk it is never finished, and so is no front end for others."""

    def __init__(
        self, folder: Path, config: Config, sequence: Sequence, selection: Selection
    ) -> None:
        about = {
            "source": sequence.name,
            "stride": str(selection.stride),
            "frames": str(len(selection.indices(sequence))),
            "config": config_yaml(config),
            "versions": json.dumps(versions()),
        }
        self._file = RecordingFile(folder / FRONT_END, about, config.record)

    def observe(self, message: Message, tick: int) -> None:
        topic = TOPICS.get(type(message))
        if topic is None:
            return
        body = msgspec.msgpack.encode(message)
        self._file.add(topic.name, topic.message, body, tick, message.stamp_ns)
        if self._file.is_open and self._file.is_over_limit():
            log.error("%s: record.max_gb or record.min_free_gb: it ends here", self._file.path)
            self._file.abandon()

    def __enter__(self) -> "FrontEndRecord":
        return self

    def __exit__(self, error: type[BaseException] | None, *_rest: object) -> None:
        if error:
            self._file.abandon()
        else:
            self._file.close()


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
            raise DataError(
                f"{path} is not whole: its run was stopped, the disk was full, or it grew past "
                "record.max_gb. Make that run again."
            )
        about = index.metadata.get(ABOUT, {})
        _require_settings(path, about.get("config", ""), config)
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

    def _messages(self, places: Places[Place]) -> tuple[Message, ...]:
        try:
            return tuple(decode(self._index.body(p), MESSAGES[p.topic]) for p in places)
        except (msgspec.DecodeError, LookupError) as error:
            raise DataError(f"{self._index.path}, frame {places[0].number}: {error}.") from error


def _require_settings(path: Path, text: str, config: Config) -> None:
    try:
        kept = config_of(plain_values(text) or {})
    except yaml.YAMLError as error:
        raise DataError(f"{path}: its configuration cannot be read: {error}.") from error
    asked, was = (dict(_settings(one)) for one in (config, kept))
    for name, value in asked.items():
        if was[name] != value:
            raise ConfigError(
                f"{name} is {value} and was {was[name]} when {path} was made: the front end does "
                "not run again. Leave it as it was, or leave out --front-end."
            )


def _settings(config: Config) -> Iterator[tuple[str, object]]:
    """Those that a front end depends on, by their dotted names."""
    tree = msgspec.to_builtins(config)
    for section in (*sorted(ACTORS), "data"):
        yield from _leaves(section, tree[section])
    yield DETECTOR_LATENCY, config.run.detector_latency_frames


def _leaves(name: str, value: object) -> Iterator[tuple[str, object]]:
    if not isinstance(value, dict):
        yield name, value
        return
    for key, inner in value.items():
        yield from _leaves(f"{name}.{key}", inner)
