"""Replay of a recording: each recorded actor runs again on its recorded inputs."""

import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import yaml

from ldo_service import kernels, versions
from ldo_service.actors.mapper import Mapper
from ldo_service.actors.topology import actor_spec
from ldo_service.config import Config, actor_parameters, config_of
from ldo_service.errors import ConfigError, DataError
from ldo_service.kernels.gpu.device import Device, gpu_facts
from ldo_service.recordings.recording import JournalFile, recorded_actors
from ldo_service.recordings.replay import ReplayReport, replay
from ldo_service.runtime import Actor
from ldo_service.storage.temporary_folder import temporary_folder
from ldo_service.storage.yaml_io import load_yaml


@dataclass(frozen=True, slots=True)
class RecordedActor:
    """Recording of one actor: one file for each process in which the actor ran."""

    name: str
    files: tuple[JournalFile, ...]

    @property
    def steps(self) -> int:
        return sum(file.steps for file in self.files)

    def replay(self, advance: Callable[[], None] = lambda: None) -> ReplayReport:
        """Replay the recording with a new actor.

        Args:
            advance: Function that is called after each step.

        Raises:
            DataError: A file cannot be read.
        """
        with temporary_folder() as folder:
            files = folder / "map"
            make = partial(self._make, files)
            has_files = self.name == Mapper.name
            return replay(self.name, self.files, make, advance, files if has_files else None)

    def verify(self) -> ReplayReport:
        """Replay the recording and compare the outputs.

        Raises:
            ReplayDiverged: An output differs from the recorded one.
            DataError: The recording is incomplete.
        """
        replayed = self.replay()
        replayed.verify()
        return replayed

    def _make(self, folder: Path, about: Mapping[str, str]) -> Actor:
        """Return a new actor with the recorded configuration, which keeps its files in `folder`."""
        make = actor_spec(self.name).make
        assert make is not None
        config = _config_of(about)
        mapper = replace(config.mapper, image_folder=str(folder))
        return make(actor_parameters(replace(config, mapper=mapper)))

    def caveats(self) -> list[str]:
        """Return the reasons why a replay on this machine may differ from the recording."""
        return [line for file in self.files[:1] for line in _caveats(file.about)]


def _config_of(about: Mapping[str, str]) -> Config:
    """Return the configuration of the recorded actor.

    Raises:
        DataError: The configuration cannot be read.
    """
    try:
        return config_of(_with_device(load_yaml(about.get("config", "")) or {}))
    except yaml.YAMLError as error:
        raise DataError(
            f"the configuration in the recording cannot be read: {error}. Copy the recording "
            "again, or make a new one."
        ) from error


def _with_device(tree: dict[str, Any]) -> dict[str, Any]:
    """Return recorded settings with `service.device` instead of `inference.providers`.

    Recordings of versions that chose the device by its execution provider can thus be replayed. The
    first provider decides. A provider that no device has stays, and is then rejected by its name.
    """
    providers = tree.get("inference", {}).get("providers") or ["cpu"]
    if providers[0] not in typing.get_args(Device):
        return tree
    inference = {k: v for k, v in tree.get("inference", {}).items() if k != "providers"}
    service = {"device": providers[0]} | tree.get("service", {})
    return tree | {"inference": inference, "service": service}


def _facts_of(about: Mapping[str, str], kind: str) -> dict[str, str]:
    """Return facts about the recording machine by name; `kind` is gpu or versions.

    Raises:
        DataError: The facts cannot be read.
    """
    try:
        return msgspec.json.decode(about.get(kind, "{}"), type=dict[str, str])
    except msgspec.DecodeError as error:
        raise DataError(
            f"the entry {kind} in the recording cannot be read: {error}. Copy the recording again, "
            "or make a new one."
        ) from error


def _gpu_caveat(about: Mapping[str, str]) -> list[str]:
    """Return a note if the replay uses another GPU than the recording, or only one of them does."""
    recorded = _facts_of(about, "gpu")
    ours = gpu_facts(_config_of(about).service.device)
    if recorded == ours:
        return []
    texts = [
        ", ".join(f"{name} {value}" for name, value in facts.items()) or "the CPU"
        for facts in (recorded, ours)
    ]
    return [
        f"recorded with {texts[0]}, replayed with {texts[1]}: the results of mapper, tracker "
        "and networks may differ. Replay on an equal device with equal versions."
    ]


def _caveats(about: Mapping[str, str]) -> list[str]:
    lines: list[str] = []
    isa, ours = about.get("isa", kernels.isa()), kernels.isa()
    if isa != ours:
        lines.append(
            f"recorded with the instruction set {isa}, replayed with {ours}: the last bits may "
            f"differ. Set LDO_ISA={isa} on a machine with that instruction set."
        )
    lines += _gpu_caveat(about)
    now = versions()
    for name, version in _facts_of(about, "versions").items():
        if now.get(name) != version:
            lines.append(
                f"recorded with {name} {version}, replayed with {now.get(name)}: the results may "
                "differ."
            )
    return lines


def open_recording(folder: Path, only: tuple[str, ...] = ()) -> list[RecordedActor]:
    """Return the recorded actors.

    Args:
        folder: Folder of the recording.
        only: Names of actors to return; empty returns all.

    Raises:
        DataError: The folder has no recording, the recording has no steps, or this service cannot
            replay the version of the recording.
        ConfigError: An actor is not in the recording.
    """
    found = recorded_actors(folder)
    if not found:
        raise DataError(f"{folder} holds no recording. `ldo record {folder}` makes one.")
    unknown = [name for name in only if name not in found]
    if unknown:
        raise ConfigError(
            f"{folder} has no recording of actor {unknown[0]!r}. Choose from: {', '.join(found)}."
        )
    actors = [
        RecordedActor(name, tuple(JournalFile(path) for path in paths))
        for name, paths in found.items()
        if not only or name in only
    ]
    for actor in actors:
        for file in actor.files:
            file.require_version()
    if not any(actor.steps for actor in actors):
        names = ", ".join(only) or "any actor"
        raise DataError(
            f"{folder} has no recorded step of {names}. Record again while camera frames arrive."
        )
    return actors
