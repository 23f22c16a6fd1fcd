"""The folder of a service's state: which service owns it, and whether its parts belong together."""

import fcntl
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

from ldo_service.errors import ConfigError
from ldo_service.runtime.delivery_state import RestoredState
from ldo_service.storage.state_store import FolderStore

# have state before the first keyframe is made
INTERDEPENDENT_ACTORS = ("tracker", "mapper", "optimizer")


def state_folder(folder: Path | None, stack: ExitStack) -> Path:
    """The given folder, or a temporary one that goes with the process. Raises ConfigError where it
    cannot be written, and where a run or a recording lies in it."""
    if folder is None:
        return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ldo-")))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise ConfigError(f"{folder} cannot be written: choose another with --state.")
        found = {path.name for path in folder.iterdir()}
    except OSError as error:
        raise ConfigError(f"{folder} cannot be used for state: {error.strerror}.") from error
    if "state" not in found and "frames.csv" in found:
        raise ConfigError(
            f"{folder} is what `ldo run` wrote, and holds no state of a service: choose another "
            f"folder with --state. To track in its map: --localize {folder}."
        )
    if "state" not in found and any(name.endswith(".mcap") for name in found):
        raise ConfigError(
            f"{folder} is a recording, and holds no state of a service: choose another folder with "
            "--state."
        )
    return folder


def claim_state(folder: Path, stack: ExitStack) -> None:
    """Keep the folder to this service, and see that the states in it belong together.

    Keyframe ids and versions run through all of them: going on from a part would join keyframes of
    two different journeys. Raises ConfigError, and DataError where the disk does not let them be
    read.
    """
    lock = stack.enter_context((folder / "lock").open("w"))
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise ConfigError(
            f"another service keeps its state in {folder}: choose another with --state."
        ) from error
    store = FolderStore(folder / "state")
    pasts = {name: RestoredState.of(store.load(name)) for name in INTERDEPENDENT_ACTORS}
    missing = [name for name, past in pasts.items() if past.is_none]
    if missing and any(past.has_passed for past in pasts.values()):
        raise ConfigError(
            f"{folder} has no readable state of {', '.join(missing)} beside that of the others. "
            "Choose another folder with --state, or delete this one to start anew."
        )
    for topic, producer, consumer in _inconsistent_states(pasts):
        raise ConfigError(
            f"in {folder} the state of {consumer} is newer than that of {producer}: it has had "
            f"messages of {topic} that were not made yet. Bring all of the folder back from one "
            "copy, choose another with --state, or delete this one to start anew."
        )


def _inconsistent_states(pasts: Mapping[str, RestoredState]) -> Iterator[tuple[str, str, str]]:
    """Topics of which a consumer had more than its producer made, and both their names."""
    for producer, past in pasts.items():
        for topic, made in past.outputs.items():
            for consumer, other in pasts.items():
                had = other.inputs.get(topic)
                if had and had.epoch == made.epoch and had.handled > made.seq:
                    yield topic, producer, consumer
