"""Every setting, its default, its unit and its reason.

A configuration file lists only what differs:

    tracker:
      hold_out: 5
    service:
      spawned: [optimizer, mapper]

An unknown key is an error that names the nearest one; `ldo config` prints the whole.
"""

import dataclasses
import difflib
import inspect
import re
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from ldo_service.actors.detector import DetectorConfig
from ldo_service.actors.frame_source import FrameSourceConfig
from ldo_service.actors.loop_closer import LoopCloserConfig
from ldo_service.actors.mapper import MapperConfig
from ldo_service.actors.optimizer import OptimizerConfig
from ldo_service.actors.tracker import TrackerConfig
from ldo_service.actors.vlm_labeller import VlmLabellerConfig
from ldo_service.datasets import SequenceOptions
from ldo_service.errors import ConfigError
from ldo_service.recordings.mcap_file import RecordConfig
from ldo_service.runtime.stage import StageConfig
from ldo_service.storage.yaml_io import plain_text, plain_values
from ldo_service.transport.endpoint import LOOPBACK, MAX_MESSAGE_MB
from ldo_service.viewer.config import ViewerConfig


@dataclass(frozen=True, slots=True)
class ServiceConfig:
    """How the actors of `ldo serve` are run."""

    spawned: tuple[str, ...] = ("optimizer",)  # in processes of their own: gtsam holds the GIL
    drain_s: float = 10.0  # a soft stop waits so long for each stage to finish what it has
    silent_after_s: float = 10.0  # a process without a heartbeat for so long is killed
    sync_state: bool = False  # a step is on the disk before it is told: a power cut costs what a
    # kill does, and each step three syncs, 12 ms on a virtual disk. False: it may cost the state
    control_timeout_s: float = 55.0  # for all actors to obey, each between two steps: the slowest
    # measured is 0.6 s, and a labeller may wait for its server for 50
    keys: str = ""  # folder that `ldo keys add` made, for TLS; --keys names another
    max_message_mb: int = MAX_MESSAGE_MB  # larger ones are dropped; a 4K frame can have 58 MB
    metrics_address: str = LOOPBACK  # who reads them sees when the robot works; 0.0.0.0: everybody

    def __post_init__(self) -> None:
        if self.drain_s < 0 or min(self.silent_after_s, self.control_timeout_s) <= 0:
            raise ConfigError(f"{self}: times must be positive.")
        if not 1 <= self.max_message_mb <= 1000:
            raise ConfigError(f"service.max_message_mb={self.max_message_mb} must be in 1..1000.")


@dataclass(frozen=True, slots=True)
class DataConfig:
    """How data sets are read whose depth and colour come from two cameras (ScanNet, 7-Scenes)."""

    register_depth: bool = False  # bring depth to the colour camera; False: as the files are
    T_color_depth: tuple[float, ...] = ()  # 16 numbers, row-major, metres; empty: the data set's

    def options(self) -> SequenceOptions:
        """Raises ConfigError for numbers that are no rigid transform."""
        if not self.T_color_depth:
            return SequenceOptions(register_depth=self.register_depth)
        if len(self.T_color_depth) != 16:
            raise ConfigError(
                f"data.T_color_depth has {len(self.T_color_depth)} numbers: write the 4x4 matrix "
                "row by row."
            )
        T_color_depth = np.array(self.T_color_depth).reshape(4, 4)
        return SequenceOptions(register_depth=self.register_depth, T_color_depth=T_color_depth)


@dataclass(frozen=True, slots=True)
class RunConfig:
    """How `ldo run` goes over a file."""

    mapper_latency_frames: int = 3  # a keyframe is in the map so many frames later, on any machine
    optimizer_latency_frames: int = 3
    loop_closer_latency_frames: int = 10  # it looks at five places at a time
    detector_latency_frames: int = 3
    vlm_labeller_latency_frames: int = 30  # a second: its answers are late by design
    max_rejected: float = 0.1  # share of unreadable frames over which the data is called bad

    def __post_init__(self) -> None:
        if min(self.latency_frames().values()) < 0:
            raise ConfigError(f"{self}: latencies must be at least 0 frames.")
        if not 0 <= self.max_rejected <= 1:
            raise ConfigError(f"run.max_rejected={self.max_rejected:g} must be within 0..1.")

    def latency_frames(self) -> dict[str, int]:
        """By actor; the others answer within the frame."""
        return {
            "detector": self.detector_latency_frames,
            "loop_closer": self.loop_closer_latency_frames,
            "mapper": self.mapper_latency_frames,
            "optimizer": self.optimizer_latency_frames,
            "vlm_labeller": self.vlm_labeller_latency_frames,
        }


@dataclass(frozen=True, slots=True)
class Config:
    frame_source: FrameSourceConfig = field(default_factory=FrameSourceConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    vlm_labeller: VlmLabellerConfig = field(default_factory=VlmLabellerConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    loop_closer: LoopCloserConfig = field(default_factory=LoopCloserConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    data: DataConfig = field(default_factory=DataConfig)
    run: RunConfig = field(default_factory=RunConfig)
    service: ServiceConfig = field(default_factory=ServiceConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    stage: StageConfig = field(default_factory=StageConfig)
    viewer: ViewerConfig = field(default_factory=ViewerConfig)

    def check_patience(self) -> None:
        """Of a service: nobody may be given up who only waits for a labeller's server.

        Raises ConfigError.
        """
        endpoint = self.vlm_labeller.http.endpoint
        longest_s = endpoint.patience_s + endpoint.timeout_s  # to connect counts anew
        limits = {
            "stage.stall_after_s": self.stage.stall_after_s,
            "service.control_timeout_s": self.service.control_timeout_s,
        }
        for name, limit_s in limits.items():
            if self.vlm_labeller.url and longest_s >= limit_s:
                raise ConfigError(
                    f"vlm_labeller.http.endpoint: patience_s={endpoint.patience_s:g} and "
                    f"timeout_s={endpoint.timeout_s:g} together must be below "
                    f"{name}={limit_s:g}: raise that, or lower these."
                )

    def with_map_folder(self, folder: Path) -> "Config":
        """The mapper keeps images and sleeping Gaussians there, if nowhere else: its successor
        finds them."""
        mapper = dataclasses.replace(self.mapper, folder=self.mapper.folder or str(folder))
        return dataclasses.replace(self, mapper=mapper)


def load_config(path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """The defaults, changed by a YAML file, changed by `section.field=value` settings.

    Raises ConfigError for what cannot be read, is not known, or makes no sense.
    """
    tree = _read(path) if path else {}
    for setting in settings:
        _apply(tree, setting)
    return config_of(tree)


def config_of(tree: dict[str, Any]) -> Config:
    """The defaults, changed by a tree of plain values."""
    _check_names(tree, Config, "")
    try:
        config = msgspec.convert(tree, Config)
        _refuse_nan(config, "")
        return config
    except msgspec.ValidationError as error:
        raise ConfigError(_without_path_sugar(str(error))) from error


def config_yaml(config: Config) -> str:
    """The whole configuration; reads back as the same."""
    return plain_text(msgspec.to_builtins(config))


def explained_yaml(config: Config) -> str:
    """The whole configuration with the reason for each default beside it."""
    return "\n".join(_explain(config, 0)) + "\n"


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = plain_values(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is no text in UTF-8.") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(tree or {}, dict):
        raise ConfigError(f"{path} must hold sections such as `tracker:`, `ldo config` shows them.")
    return tree or {}


def _apply(tree: dict[str, Any], setting: str) -> None:
    name, equals, value = setting.partition("=")
    if not equals or "." not in name:
        raise ConfigError(f"--set {setting}: write it as section.field=value.")
    *sections, last = name.strip().split(".")
    for section in sections:
        tree = tree.setdefault(section, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"--set {setting}: {section} is no section.")
    try:
        tree[last] = plain_values(value)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {setting}: the value is not valid YAML: {error}") from error


def _check_names(tree: Any, schema: type, prefix: str) -> None:
    if not isinstance(tree, dict):
        return  # the conversion says what was expected here
    types = typing.get_type_hints(schema)
    for name, value in tree.items():
        if name not in types:
            near = difflib.get_close_matches(str(name), types, 1)
            hint = f"Did you mean {prefix}{near[0]}?" if near else f"Known: {', '.join(types)}."
            raise ConfigError(f"there is no setting {prefix}{name}. {hint}")
        if dataclasses.is_dataclass(types[name]):
            _check_names(value, types[name], f"{prefix}{name}.")


def _refuse_nan(config: Any, prefix: str) -> None:
    """NaN passes every comparison that a section makes."""
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        if dataclasses.is_dataclass(value):
            _refuse_nan(value, f"{prefix}{entry.name}.")
        elif value != value or (isinstance(value, tuple) and any(v != v for v in value)):
            raise ConfigError(f"{prefix}{entry.name} is NaN: write a number.")


def _without_path_sugar(message: str) -> str:
    """msgspec ends with "- at `$.tracker.hold_out`": say it as the user wrote it."""
    return re.sub(r" - at `\$\.?(.*?)`$", r", in \1.", message)


_FIELD = re.compile(r"^ {4}(?P<name>\w+): [^#]*(?:#\s*(?P<comment>.*))?$")
_COMMENT = re.compile(r"^ {4,}# (?P<comment>.+)$")


def _explain(config: Any, depth: int) -> list[str]:
    comments = _comments(type(config))
    lines = []
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        indent = "  " * depth
        if dataclasses.is_dataclass(value):
            lines += [f"{indent}{entry.name}:", *_explain(value, depth + 1)]
        else:
            plain = msgspec.to_builtins(value)
            text = plain_text(plain, flow=True, width=inf).splitlines()[0]
            comment = f"  # {comments[entry.name]}" if entry.name in comments else ""
            lines.append(f"{indent}{entry.name}: {text}{comment}")
    return lines or ["  " * depth + "{}"]


def _comments(schema: type) -> dict[str, str]:
    """The comment of each field in the source: beside it, with the lines that continue it, or, of
    one that has none beside it, the lines above it that begin a sentence."""
    comments: dict[str, list[str]] = {}
    last, block = "", list[str]()
    for line in inspect.getsource(schema).splitlines():
        if line.startswith(("    def ", "    @")):
            break
        if found := _FIELD.match(line):
            name, beside = found["name"], found["comment"]
            is_above = not beside and bool(block) and block[0][0].isupper()
            comments[name] = [beside] if beside else block if is_above else []
            comments.get(last, []).extend([] if is_above else block)
            last, block = name, []
        elif found := _COMMENT.match(line):
            block.append(found["comment"])
    comments.get(last, []).extend(block)
    return {name: " ".join(lines) for name, lines in comments.items() if lines}
