"""State folder of a service: its lock, and checks of the actors' saved states."""

import fcntl
import logging
import os
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

from ldo_service.errors import ConfigError, UnavailableError
from ldo_service.runtime.delivery_state import RestoredState
from ldo_service.storage.state_store import CONTENTS, FolderStore

log = logging.getLogger(__name__)

# File that exists while a reset of the actors is not complete; see `Control`.
RESET_MARKER = "reset"
PAUSE_MARKER = "paused"  # File that exists while the service is paused.
# Actors whose states refer to each other. Each one saves a state before the first keyframe arrives.
INTERDEPENDENT_ACTORS = ("tracker", "mapper", "optimizer")


def state_folder(folder: Path | None, stack: ExitStack) -> Path:
    """Check or create the state folder.

    Args:
        folder: The folder; None for a temporary one that is deleted with `stack`.
        stack: Exit stack that is closed when the service ends.

    Returns:
        The folder, which exists.

    Raises:
        ConfigError: The folder cannot be written, or contains a run or a recording.
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
            f"{folder} contains a run of `ldo run`, not the state of a service. Choose another "
            f"folder with --state. To localize in the map of the run, use --localize {folder}."
        )
    if "state" not in found and any(name.endswith(".mcap") for name in found):
        raise ConfigError(
            f"{folder} contains a recording, not the state of a service. Choose another folder "
            "with --state."
        )
    return folder


def claim_state(folder: Path, stack: ExitStack, remote_actors: Collection[str] = ()) -> None:
    """Lock the folder for this service, and check that the states of all actors match.

    The states of tracker, mapper and optimizer refer to the same keyframe ids and graph versions.
    If one state were missing or older, the service would connect keyframes of two different runs.

    Args:
        folder: The state folder.
        stack: Exit stack that releases the lock when the service ends.
        remote_actors: Actors that another machine runs; their states are not in the folder.

    Raises:
        ConfigError: The states do not match.
        UnavailableError: Another service uses the folder.
        DataError: A state cannot be read because of a disk error.
    """
    lock = stack.enter_context((folder / "lock").open("w"))
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise UnavailableError(
            f"another service uses the state folder {folder}. Choose another folder with --state."
        ) from error
    store = FolderStore(folder / "state")
    _complete_reset(folder, store, remote_actors)
    local = [name for name in INTERDEPENDENT_ACTORS if name not in remote_actors]
    pasts = {name: RestoredState.of(store.load(name)) for name in local}
    missing = [name for name, past in pasts.items() if past.is_none]
    if missing and any(past.has_passed for past in pasts.values()):
        raise ConfigError(
            f"{folder} has no readable state of {', '.join(missing)}, but has states of other "
            "actors. Choose another folder with --state, or delete this folder to start with an "
            "empty map."
        )
    for topic, producer, consumer, why in _inconsistent_states(pasts):
        raise ConfigError(
            f"in {folder} the states of {producer} and {consumer} do not belong together: {why} "
            f"on {topic}. Restore the whole folder from one copy, choose another folder with "
            "--state, or delete this folder to start with an empty map."
        )


def _complete_reset(folder: Path, store: FolderStore, remote_actors: Collection[str]) -> None:
    """Delete the states of the local actors if the previous process was killed during a reset.

    If there are remote actors, the marker stays: `Control` then resets them too, and removes the
    marker.
    """
    marker = folder / RESET_MARKER
    if not marker.exists():
        return
    log.warning(
        "%s: the previous process ended during a reset, which is completed now: the service starts "
        "with an empty map.",
        folder,
    )
    for state in sorted((folder / "state").glob(f"*/{CONTENTS}")):
        store.delete(state.parent.name)
    if not remote_actors:
        marker.unlink()


def _inconsistent_states(
    pasts: Mapping[str, RestoredState],
) -> Iterator[tuple[str, str, str, str]]:
    """Yield each topic of which the saved states of producer and consumer do not fit.

    The consumer has then handled messages of another run, or messages unknown to the producer,
    whose saved state is older. Each item has the topic, the producer, the consumer, and a
    description of the difference.
    """
    for producer, past in pasts.items():
        for topic, made in past.outputs.items():
            for consumer, other in pasts.items():
                had = other.inputs.get(topic)
                if had is None or not had.handled:
                    continue
                if had.epoch != made.epoch:
                    yield topic, producer, consumer, f"{consumer} has messages of another run"
                elif had.handled > made.seq:
                    newer = f"{consumer} is newer than {producer}, and has messages that {producer}"
                    yield topic, producer, consumer, f"{newer} has not produced"
