"""Checkpoints of a stage: the actor's state and the delivery state, saved in one write."""

import logging
import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from ldo_service.storage.atomic_write import sync_all, with_folders
from ldo_service.storage.generation_files import GenerationFiles
from ldo_service.storage.saved_files import SavedFiles
from ldo_service.storage.state_store import FolderStore, State, StateStore
from ldo_service.transport.flow_control import InletPosition, OutletPosition

from .actor import Actor
from .delivery_state import DeliveryState, LoggedInput, RestoredState, restore_actor
from .supervision_policy import LOG_PERIOD_S, LogLimit

log = logging.getLogger(__name__)

# Maximum number of files of the map in the list of unsynced files, which each saved state contains.
# A save with more files syncs them. A service with generations has about 20 at a time.
MAX_UNSYNCED_FILES = 100
# Maximum size of the files that only older generations need, bytes. A larger size deletes the
# generations. A service that completes them retires a few MB in between. More than 1 GB could fill
# a small disk, such as an SD card of 32 GB.
MAX_RETIRED_BYTES = 1_000_000_000


class Checkpointer:
    """Writer and reader of the saved state of one stage.

    The stage calls `build_checkpoint` and `write` in its actor's thread.
    """

    def __init__(self, store: StateStore) -> None:
        self._store, self._ledger = store, DeliveryState()
        self.past = RestoredState()
        self._name = ""  # Name of the actor.
        self.is_unsaved = False  # True if the last step is not saved.
        self._failed = 0
        self._has_fallen_back = False
        self._last_kept = 0  # Last generation that this stage has kept; 0: none to rely on.
        self._give_up_failures = LogLimit(LOG_PERIOD_S)

    def restore_actor(self, make: Callable[[], Actor]) -> Actor:
        """Create an actor and restore its last saved state, if there is one.

        Args:
            make: Function that creates a new actor.
        """
        fresh = make()
        self._name = fresh.name
        self.past = RestoredState.of(self._store.load(fresh.name))
        self._sync_files(fresh.name)
        self._has_fallen_back = self._store.has_fallen_back(fresh.name)
        if self.past.of_actor:
            log.info("%s: restored from its last saved state.", fresh.name)
        return restore_actor(fresh, self.past, make)

    def _sync_files(self, name: str) -> None:
        """Sync the files of the state, because the new actor does not know which ones need it."""
        if not isinstance(self._store, FolderStore):
            return
        try:
            SavedFiles(self._store, name).sync_unsynced()
        except OSError as error:  # Tracking works even if the disk is full.
            log.error("%s: the files of its state cannot be synced: %s. A power cut may damage "
                      "them. Check the disk.", name, error)  # fmt: skip

    def forget(self, name: str) -> None:
        """Delete the saved state, so that the actor starts empty."""
        self._store.delete(name)
        self._last_kept = 0
        self._ledger = DeliveryState()

    def links(
        self, inputs: Mapping[str, InletPosition], outputs: Mapping[str, OutletPosition | None]
    ) -> State:
        """Return the offsets and the unhandled outputs of the stage, as parts of its state.

        Args:
            inputs: Position on each lossless input, by topic name.
            outputs: Position on each output, by topic name; None if the topic has no required
                consumer.
        """
        return self._ledger.links(
            inputs, {topic: past for topic, past in outputs.items() if past is not None}
        )

    def build_checkpoint(
        self, actor: Actor, links: State, taken: LoggedInput | None, whole: bool
    ) -> State:
        """Return the state to write after a step.

        Args:
            actor: The actor of the stage.
            links: Offsets and unhandled outputs of the stage, as `links` returns them.
            taken: Input of the last step, for the write-ahead log; None if `Actor.lags` is
                False.
            whole: Save `Actor.checkpoint`, the complete state, instead of `Actor.snapshot`. The
                complete state is also saved if the write-ahead log is full.
        """
        is_whole = whole or self._ledger.is_long
        own = actor.checkpoint() if is_whole else actor.snapshot()
        return {**self._ledger.own(own, taken, is_whole), **links}

    def write(self, actor: Actor, state: State) -> None:
        """Write the state.

        Raises:
            OSError: The state cannot be written, for example because the disk is full.
        """
        files = actor.files
        unsynced = files.unsynced_files() if files else []
        if files and (self._store.syncs or len(unsynced) > MAX_UNSYNCED_FILES):
            sync_all(with_folders(unsynced))  # First, because the state refers to them.
            files.begin_sync()
            files.end_sync()
            unsynced = []
        self._store.save(actor.name, state, unsynced)
        if self.is_unsaved:
            self.is_unsaved = False
            log.info("%s: its state is saved again; no action needed.", actor.name)

    def notify(self, actor: Actor) -> None:
        """Notify the actor that its state is saved.

        Raises:
            Exception: Any exception of the actor. The state is saved nevertheless, so the step must
                not be repeated.
        """
        if self._store.is_kept(actor.name) and actor.files:
            self._bound_retired_files(actor.name, actor.files.retired_bytes())
        if not self._store.is_kept(actor.name):
            actor.on_saved()

    def _bound_retired_files(self, name: str, size_bytes: int) -> None:
        """Delete the generations of the state if they need too many files of the actor."""
        if size_bytes > MAX_RETIRED_BYTES:
            try:
                self._store.give_up(name)
            except OSError as error:
                if self._give_up_failures.is_due():
                    log.error(
                        "%s: its older generations cannot be deleted: %s. They need %.0f MB of "
                        "files that are otherwise unused. The next step tries again. Check the "
                        "disk.",
                        name, error, 1e-6 * size_bytes,
                    )  # fmt: skip
                return
            self._last_kept = 0
            log.error(
                "%s: no generation of the states was completed while %.0f MB of files became "
                "unused, so the older generation is deleted. A power cut now could damage the only "
                "state. Check the disk, and the actors with `ldo doctor`.",
                name, 1e-6 * size_bytes,
            )  # fmt: skip

    def is_last_kept(self, generation: int) -> bool:
        """Return whether this stage has kept its state in `generation`, and in no later one."""
        return generation != 0 and generation == self._last_kept

    def keep(
        self, actor: Actor, generation: int, completed: int
    ) -> tuple[GenerationFiles | None, list[Path]]:
        """Keep the last saved state as a generation; see `runtime.generations`.

        A generation is a synced copy of the states of all actors.

        Args:
            actor: The actor.
            generation: Number of the generation.
            completed: Number of the newest generation that all actors have completed.

        Returns:
            Two values: the files of the generation, which the caller must write, and further files
            and folders, which the caller must sync.

        Raises:
            OSError: A file cannot be read.
        """
        is_previous_complete = self.is_last_kept(completed)
        if actor.files is None:
            kept, unsynced = self._store.keep(actor.name, generation, completed), []
        else:
            if is_previous_complete:
                actor.files.end_sync()
            unsynced = actor.files.unsynced_files()
            kept = self._store.keep(actor.name, generation, completed, unsynced)
            actor.files.kept(is_previous_complete=is_previous_complete)
            actor.files.begin_sync()
        self._last_kept = generation
        return kept, with_folders(unsynced)

    def record_failure(self, name: str, error: OSError) -> bool:
        """Count a failed save, and log the first of several failures in a row.

        Returns:
            True if this is the first failure since the last successful save.
        """
        self._failed += 1
        is_first, self.is_unsaved = not self.is_unsaved, True
        if is_first:
            log.error(
                "%s: saving the state after the last step failed: %r. The stage retries. Until a "
                "save succeeds, it sends no outputs to required consumers. Free some disk space, "
                "or choose another folder with --state.",
                name, error,
            )  # fmt: skip
        return is_first

    def metrics(self) -> dict[str, float]:
        """Return sizes on disk, and counters of failed saves and damaged states, if any.

        `state_mb` is the size of the actor's state and of its older copies, MB.
        """
        metrics: dict[str, float] = {}
        if isinstance(self._store, FolderStore):
            with suppress(OSError):  # The folder does not exist before the first save.
                metrics["state_mb"] = _size_bytes(self._store.folder / self._name) / 1e6
            with suppress(OSError):
                metrics["disk_free_mb"] = shutil.disk_usage(self._store.folder).free / 1e6
        if self._failed:
            metrics["checkpoint_failing"] = float(self.is_unsaved)
            metrics["checkpoints_failed"] = self._failed
        if self._has_fallen_back:
            metrics["fell_back"] = 1.0  # The last state was damaged, and an older one is used.
        return metrics


def _size_bytes(folder: Path) -> int:
    """Return the size of the files of a folder.

    Raises:
        OSError: The folder cannot be read.
    """
    size = 0
    with os.scandir(folder) as files:
        for file in files:
            with suppress(FileNotFoundError):  # A generation was deleted or renamed meanwhile.
                size += file.stat().st_size
    return size
