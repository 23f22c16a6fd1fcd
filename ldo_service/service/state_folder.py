"""State folder of a service: lock and consistency of its states."""

import fcntl
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

from ldo_service.errors import ConfigError
from ldo_service.runtime.delivery_state import RestoredState
from ldo_service.storage.state_store import FolderStore

# Actors that have state before the first keyframe.
INTERDEPENDENT_ACTORS = ("tracker", "mapper", "optimizer")


def state_folder(folder: Path | None, stack: ExitStack) -> Path:
    """Check or create the state folder.

    Args:
        folder: The folder; None for a temporary one that is deleted with `stack`.
        stack: Closed when the service ends.

    Raises:
        ConfigError: The folder cannot be written, or holds a run or a recording.
    """
    if folder is None:
        return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ldo-")))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise ConfigError(f"{folder} cannot be written. Choose another folder with --state.")
        found = {path.name for path in folder.iterdir()}
    except OSError as error:
        raise ConfigError(
            f"{folder} cannot be used for state: {error.strerror}. Choose another folder with "
            "--state."
        ) from error
    if "state" not in found and "frames.csv" in found:
        raise ConfigError(
            f"{folder} is what `ldo run` wrote, and holds no state of a service. Choose another "
            f"folder with --state. To localize in its map, use --localize {folder}."
        )
    if "state" not in found and any(name.endswith(".mcap") for name in found):
        raise ConfigError(
            f"{folder} is a recording, and holds no state of a service. Choose another folder with "
            "--state."
        )
    return folder


def claim_state(folder: Path, stack: ExitStack) -> None:
    """Lock the folder for this service, and check that its states belong together.

    All states share keyframe ids and versions. Continuing from some of them would connect keyframes
    of two different runs.

    Raises:
        ConfigError: Another service uses the folder, or its states do not belong together.
        DataError: A state cannot be read because of the disk.
    """
    lock = stack.enter_context((folder / "lock").open("w"))
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise ConfigError(
            f"another service keeps its state in {folder}. Choose another folder with --state."
        ) from error
    store = FolderStore(folder / "state")
    pasts = {name: RestoredState.of(store.load(name)) for name in INTERDEPENDENT_ACTORS}
    missing = [name for name, past in pasts.items() if past.is_none]
    if missing and any(past.has_passed for past in pasts.values()):
        raise ConfigError(
            f"{folder} has no readable state of {', '.join(missing)}, but of the other actors. "
            "Choose another folder with --state, or delete this one to start with an empty map."
        )
    for topic, producer, consumer in _inconsistent_states(pasts):
        raise ConfigError(
            f"in {folder} the state of {consumer} is newer than that of {producer}: it has handled "
            f"messages of {topic} that {producer} has not produced. Restore the whole folder from "
            "one copy, choose another with --state, or delete this one to start with an empty map."
        )


def _inconsistent_states(pasts: Mapping[str, RestoredState]) -> Iterator[tuple[str, str, str]]:
    """Yield topic, producer and consumer where the consumer handled more than was produced."""
    for producer, past in pasts.items():
        for topic, made in past.outputs.items():
            for consumer, other in pasts.items():
                had = other.inputs.get(topic)
                if had and had.epoch == made.epoch and had.handled > made.seq:
                    yield topic, producer, consumer
