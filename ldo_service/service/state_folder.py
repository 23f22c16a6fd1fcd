"""State folder of a service: its lock, and checks of the actors' saved states."""

import errno
import fcntl
import logging
import os
from collections.abc import Collection
from contextlib import ExitStack
from pathlib import Path

from ldo_service.errors import ConfigError, DamagedStateError, DataError, UnavailableError
from ldo_service.runtime.generations import (
    INTERDEPENDENT_ACTORS,
    MARKER,
    actors_of_completed,
    completed_generation,
    keep_stopped,
    next_generation,
    problem_of_completed,
    problem_of_states,
)
from ldo_service.storage.atomic_write import make_folder, sync, write_atomically
from ldo_service.storage.saved_files import SavedFiles
from ldo_service.storage.state_contents import require_known_versions
from ldo_service.storage.state_store import CONTENTS, FolderStore
from ldo_service.storage.temporary_folder import temporary_folder

log = logging.getLogger(__name__)

# File that exists while a reset of the actors is not complete; see `Control`.
RESET_MARKER = "reset"
# File that exists while not all actors have fallen back to the older generation.
FALL_BACK_MARKER = "falling_back"
PAUSE_MARKER = "paused"  # File that exists while the service is paused.
# Errors of a path that cannot become a folder. After any other error, such as a file system that is
# read-only, full or not mounted yet, a later attempt may succeed. Wrong permissions count as such
# too, because a mount or a deployment may still set them; see decision 0113.
_OF_PATH = (errno.ENOTDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL)


def state_folder(folder: Path | None, stack: ExitStack) -> Path:
    """Check or create the state folder.

    Args:
        folder: The folder. None: a temporary folder is created, and deleted when `stack` closes.
        stack: Exit stack that is closed when the service ends.

    Returns:
        The path of the folder.

    Raises:
        ConfigError: The path is no folder, or the folder contains a run or a recording.
        UnavailableError: The folder cannot be written now.
    """
    if folder is None:
        return stack.enter_context(temporary_folder())
    try:
        make_folder(folder)
        if not os.access(folder, os.W_OK):
            is_read_only = os.statvfs(folder).f_flag & os.ST_RDONLY
            number = errno.EROFS if is_read_only else errno.EACCES
            raise OSError(number, os.strerror(number))
        found = {path.name for path in folder.iterdir()}
    except OSError as error:
        raise _folder_error(folder, error) from error
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


def _folder_error(folder: Path, error: OSError) -> ConfigError:
    """Return the error of a folder that cannot be used; its type tells if a retry can help."""
    problem = f"{folder} cannot be used for state: {error.strerror or error}"
    if error.errno in _OF_PATH:
        return ConfigError(f"{problem}. Choose another folder with --state.")
    return UnavailableError(
        f"{problem}. Make the folder writable, or choose another one with --state."
    )


def write_config(folder: Path, text: str) -> Path:
    """Write the configuration for child processes to the state folder, unless it is there already.

    A service whose configuration has not changed therefore starts even if the disk is full.

    Args:
        folder: The state folder.
        text: The configuration in YAML.

    Returns:
        The path of the file.

    Raises:
        UnavailableError: The file cannot be read or written now.
    """
    path, body = folder / "config.yaml", text.encode()
    try:
        if not path.exists() or path.read_bytes() != body:
            write_atomically(path, body)
    except OSError as error:
        raise UnavailableError(
            f"{path} cannot be written: {error.strerror}. Free some disk space, or choose another "
            "folder with --state."
        ) from error
    return path


def claim_state(folder: Path, stack: ExitStack, remote_actors: Collection[str] = ()) -> None:
    """Lock the folder for this service, and check that the states of all actors match.

    The states of the actors refer to the same keyframe ids and graph versions. If one state were
    missing or older, the service would connect keyframes of two different runs. A generation is a
    synced copy of all states; see `runtime.generations`. If a state is damaged, or if the states do
    not match, all actors fall back to the last complete generation.

    Args:
        folder: The state folder.
        stack: Exit stack that releases the lock when the service ends.
        remote_actors: Actors that another machine runs; their states are not in the folder.

    Raises:
        ConfigError: The states do not match, and there is no older generation.
        UnavailableError: Another service uses the folder, or it cannot be read or written now.
        DamagedStateError: A state is damaged, and there is no undamaged older generation.
        DataError: A state cannot be read because the process has reached a limit, such as that of
            open files, or because another version of the service wrote the state.
    """
    try:
        lock = stack.enter_context((folder / "lock").open("w"))
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _check_states(folder, remote_actors)
    except BlockingIOError as error:
        raise UnavailableError(
            f"another service uses the state folder {folder}. Choose another folder with --state."
        ) from error
    except OSError as error:
        raise _folder_error(folder, error) from error


def _check_states(folder: Path, remote_actors: Collection[str]) -> None:
    """Check the states in a locked folder, and fall back if they are damaged; see `claim_state`."""
    store = FolderStore(folder / "state")
    require_known_versions(store.folder)  # Finishing a reset deletes files.
    _complete_reset(folder, store, remote_actors)
    found = {path.parent.name for path in store.folder.glob("*/*.msgpack")}
    try:
        older = completed_generation(store)
        found |= actors_of_completed(store)
    except DamagedStateError as error:
        log.error("%s. There is no older generation of the states until the next one is kept.",
                  error)  # fmt: skip
        older = None
    actors = sorted((found | set(INTERDEPENDENT_ACTORS)) - set(remote_actors))
    if (folder / FALL_BACK_MARKER).exists():
        unfinished = "the previous start ended while the actors fell back to an older generation"
        _fall_back(store, actors, DamagedStateError(unfinished), older)
    elif problem := problem_of_states(store, actors):
        _fall_back(store, actors, problem, older)
    try:
        for actor in actors:
            SavedFiles(store, actor).sync_unsynced()
        if older is None:
            make_folder(store.folder)
            keep_stopped(store, actors, next_generation(store))
    except OSError as error:  # Tracking works even if the disk is full.
        log.error("%s: the states cannot be kept as an older generation: %s. A power cut may lose "
                  "them until that succeeds. Free some disk space.", folder, error)  # fmt: skip


def _fall_back(
    store: FolderStore, actors: Collection[str], problem: DataError | str, older: int | None
) -> None:
    """Replace the states of all actors by the last complete generation.

    A marker exists until all states are replaced. If this process is killed before, some states are
    older than others, and the check of the states may not notice that.

    Args:
        store: Store of the states.
        actors: The actors.
        problem: Why the states after the last step cannot be used.
        older: Number of the generation; None if there is none.

    Raises:
        ConfigError: The states do not match, and there is no older generation.
        DamagedStateError: A state is damaged, and there is no undamaged older generation.
        UnavailableError: The disk cannot be written now; the next start tries again.
    """
    advice = (
        "Restore the whole folder from one copy, choose another folder with --state, or delete "
        "this folder to start with an empty map."
    )
    if older is None:
        if isinstance(problem, str):
            raise ConfigError(f"in {store.folder.parent} {problem}. {advice}")
        raise DamagedStateError(
            f"{problem}. There is no older copy of the states to fall back to. {advice}"
        )
    if damage := problem_of_completed(store, sorted(actors), older):
        raise DamagedStateError(
            f"{problem}. The older copy of the states, generation {older}, is not usable either: "
            f"{damage}. {advice}"
        )
    log.error(
        "%s: %s. All actors fall back to generation %d of their states. The keyframes since then, "
        "usually fewer than five, are lost. Check the disk, unless the power failed.",
        store.folder.parent, problem, older,
    )  # fmt: skip
    marker = store.folder.parent / FALL_BACK_MARKER
    try:
        write_atomically(marker, b"", syncs=True)
        for actor in actors:
            store.fall_back(actor, older)
        marker.unlink()
        sync(marker.parent)  # Otherwise a power cut could bring the marker back.
    except OSError as error:
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        advice = "Free some disk space" if is_full else "Make the folder writable"
        raise UnavailableError(
            f"{store.folder.parent} cannot fall back to generation {older} of the states: {error}. "
            f"{advice}; the next start tries again."
        ) from error


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
    (store.folder / MARKER).unlink(missing_ok=True)  # The states of this generation are deleted.
    (folder / FALL_BACK_MARKER).unlink(missing_ok=True)
    if not remote_actors:
        marker.unlink()
        sync(folder)  # Otherwise a power cut could bring the marker back.
