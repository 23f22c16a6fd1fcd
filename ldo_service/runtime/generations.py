"""Generations: synced copies of the states of all actors, to which the service falls back.

A power cut or a bad disk may damage the state that an actor saved after its last step. The actors
of a service keep their states as a generation about once a second, while messages arrive. A
generation is synced to the disk. The states of all actors in it belong together: no consumer has
handled a message that its producer has not produced, and each producer still has all messages that
a consumer has not handled.

`GenerationKeeper` asks the actors one after the other, consumers first, so that the state of a
producer is newer than those of its consumers. It then compares the positions on all topics in these
states. If the positions are consistent, it writes the number of the generation to the marker file,
which completes the generation. When an actor begins to write a new generation, it deletes its
copies of all older generations except the last complete one.
"""

import asyncio
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress

from ldo_service.errors import DamagedStateError, DataError
from ldo_service.storage.atomic_write import write_atomically
from ldo_service.storage.saved_files import SavedFiles
from ldo_service.storage.state_contents import StateContents, read_contents
from ldo_service.storage.state_store import CONTENTS, GENERATION, NEWEST, FolderStore, list_name

from .delivery_state import OFFSETS, OUTBOX, RestoredState
from .stage_commands import CommandSender
from .supervision_policy import LOG_PERIOD_S, LogLimit

log = logging.getLogger(__name__)

MARKER = "generation.msgpack"  # File with the number of the last complete generation.
# Time between two generations, seconds. A power cut loses the keyframes of this time and of the
# time to sync a generation: at two keyframes per second, fewer than five.
KEEP_EVERY_S = 1.0
FAILURES_TO_LOG = 5  # Number of failures in a row after which one is logged.
# Time that an actor has to keep its state, seconds. It includes a step of the actor. The time
# doubles after each failure up to the maximum, because a large map on a slow disk takes longer.
KEEP_WITHIN_S, MAX_KEEP_WITHIN_S = 5.0, 60.0
# Actors whose states refer to each other. Each one saves a state before the first keyframe arrives.
INTERDEPENDENT_ACTORS = ("tracker", "mapper", "optimizer")


def completed_generation(store: FolderStore) -> int | None:
    """Return the number of the last complete generation; None if there is none.

    A generation is a synced copy of the states of all actors.

    Raises:
        DamagedStateError: The marker file is damaged.
        DataError: Another version of the service wrote the marker file.
        OSError: The marker file cannot be read.
    """
    marker = read_contents(store.folder / MARKER)
    return marker.generation if marker else None


def complete_generation(store: FolderStore, number: int) -> None:
    """Write the marker file: the number of the last generation whose states are all on the disk.

    A generation has copies of the states of all actors at one time. The marker also lists the
    actors that have a state in it.

    Raises:
        OSError: The disk is full or cannot be written. The marker file may have the number already.
    """
    lists = store.folder.glob("*/" + list_name(number))
    marker = StateContents({path.parent.name: path.name for path in lists}, generation=number)
    write_atomically(store.folder / MARKER, marker.encode(), syncs=True)


def confirm_completed(store: FolderStore) -> int:
    """Write the marker file again, and return the number of the last complete generation.

    After a failed sync, a reader finds the new marker file, but a power cut may bring back the old
    file. No generation may be deleted until this function has succeeded.

    Returns:
        The number; 0 if there is no complete generation, or if the marker file is damaged.

    Raises:
        OSError: The disk is full or cannot be written.
        DataError: Another version of the service wrote the marker file.
    """
    try:
        marker = read_contents(store.folder / MARKER)
    except DamagedStateError:
        return 0
    if marker is None:
        return 0
    write_atomically(store.folder / MARKER, marker.encode(), syncs=True)
    return marker.generation


def actors_of_completed(store: FolderStore) -> set[str]:
    """Return the actors that have a state in the last complete generation.

    A generation is a synced copy of the states of all actors.

    Raises:
        DamagedStateError: The marker file is damaged.
        DataError: Another version of the service wrote the marker file.
        OSError: The marker file cannot be read.
    """
    marker = read_contents(store.folder / MARKER)
    return set(marker.files) if marker else set()


def problem_of_completed(
    store: FolderStore, actors: Sequence[str], number: int
) -> DataError | str | None:
    """Check the states of the last complete generation: synced copies of the states of all actors.

    The marker file (`generation.msgpack`) lists the actors that have a state in the generation. A
    missing state of a listed actor is a problem. Actors without a state at that time are not
    listed.

    Args:
        store: Store of the states.
        actors: The actors.
        number: Number of the last complete generation.

    Returns:
        None if the states are valid; a DataError if a state is damaged; a text if a state is
        missing, or if two states do not belong together.

    Raises:
        DataError: A state or the marker file cannot be read, see `problem_of_states`.
    """
    had_state = actors_of_completed(store)
    lost = [actor for actor in actors if actor in had_state and not store.exists(actor, number)]
    if lost:
        return f"its state of {', '.join(lost)} is missing"
    return problem_of_states(store, actors, number)


def next_generation(store: FolderStore) -> int:
    """Return a number that no generation on the disk has."""
    names = (
        path.stem.rpartition("-")[2] for path in store.folder.glob("*/" + GENERATION.format("*"))
    )
    used = [int(name) for name in names if name.isdecimal()]
    with suppress(DamagedStateError):
        used.append(completed_generation(store) or 0)
    return max(used, default=0) + 1


def problem_of_states(
    store: FolderStore, actors: Sequence[str], generation: int = NEWEST, *, is_quick: bool = False
) -> DataError | str | None:
    """Check that the states of all actors are undamaged and belong together.

    Args:
        store: Store of the states.
        actors: The actors.
        generation: Number of the generation to check. By default, the function checks the states
            that the actors saved after their last steps.
        is_quick: Read only the positions on each topic, and not the states themselves.

    Returns:
        None if the states are valid; a DataError if a state is damaged; a text if a state is
        missing, or if two states do not belong together.

    Raises:
        DataError: A state cannot be read because of the disk or a limit of the process, or another
            version of the service wrote the state.
    """
    prefixes = (OFFSETS, OUTBOX) if is_quick else ("",)
    pasts: dict[str, RestoredState] = {}
    for actor in actors:
        try:
            pasts[actor] = RestoredState.of(store.load(actor, generation, prefixes))
            if not is_quick:
                SavedFiles(store, actor).check_unsynced(generation)
        except DamagedStateError as error:
            return error
    missing = [
        actor
        for actor in actors
        if not store.exists(actor, generation)
        and (actor in INTERDEPENDENT_ACTORS or (generation == NEWEST and store.is_kept(actor)))
    ]
    if missing and any(past.has_passed for past in pasts.values()):
        return f"there is no state of {', '.join(missing)}, but there are states of other actors"
    return next(_inconsistent_states(pasts), None)


def _inconsistent_states(pasts: Mapping[str, RestoredState]) -> Iterator[str]:
    """Describe each topic of which the saved states of producer and consumer are inconsistent.

    The consumer has then handled messages of another run, or messages unknown to the producer,
    whose saved state is older. Or the consumer's state is older, and needs messages that the
    producer no longer has.
    """
    for producer, past in pasts.items():
        for topic, made in past.outputs.items():
            for consumer, other in pasts.items():
                had = other.inputs.get(topic)
                if had is None:
                    continue
                why = ""
                if not had.handled or had.epoch == made.epoch:
                    if had.handled > made.seq:
                        newer = f"{consumer} is newer than {producer}, and has messages that "
                        why = f"{newer}{producer} has not produced"
                    elif had.handled < made.handled and made.logged_from is None:
                        why = f"{consumer} lacks messages that {producer} no longer has"
                else:
                    why = f"{consumer} has messages of another run"
                if why:
                    yield (
                        f"the states of {producer} and {consumer} do not belong together: {why} on "
                        f"{topic}"
                    )


class GenerationKeeper:
    """Task of a running service that regularly writes a generation to the disk.

    A generation is a synced copy of the states of all actors, to which the service falls back.
    """

    def __init__(self, sender: CommandSender, store: FolderStore, actors: Sequence[str]) -> None:
        """Prepare the task; `run` starts it.

        Args:
            sender: Client of the stages.
            store: Store of the states.
            actors: Names of the actors in the order of `consumers_first`.
        """
        self._sender, self._store = sender, store
        self._actors = tuple(actors)
        self._completed = 0  # Last complete generation.
        self._is_confirmed = False  # True if the disk is certain to have this number.
        self._positions: list[str] = []
        self._within_s = KEEP_WITHIN_S
        self._failures = 0  # Failed generations since the last complete one.
        self._current_s = time.monotonic()  # Time when the last complete one was up to date.
        self._errors = LogLimit(LOG_PERIOD_S)
        self.lock = asyncio.Lock()  # Held while a generation is kept, and during a reset.

    def age_s(self) -> float:
        """Return the time since the last complete generation was up to date, seconds.

        A generation is a synced copy of the states of all actors. It is up to date until an actor
        handles another message. Any thread may call this method.
        """
        return time.monotonic() - self._current_s

    async def run(self) -> None:
        """Write a synced copy of all states every `KEEP_EVERY_S` seconds while messages arrive.

        See `keep`. The method ends only when its task is cancelled.
        """
        while True:
            async with self.lock:
                await self.keep()
            await asyncio.sleep(KEEP_EVERY_S)

    async def keep(self, *, is_forced: bool = False) -> str:
        """Keep one generation: write a synced copy of the states of all actors.

        The caller must hold `lock`. If an actor does not answer, or if the states do not belong
        together, the previous generation stays the last complete one.

        Args:
            is_forced: Keep a generation even if no messages were handled since the last one.

        Returns:
            An empty text if the last complete generation is now up to date. Otherwise, the reason
            why no new one is complete.
        """
        try:
            problem = await self._keep(is_forced=is_forced)
        except (OSError, DataError) as error:
            problem = str(error) or repr(error)  # An OSError may have no text.
        except Exception as error:  # If this task ended, no generation would be kept.
            problem = repr(error)
            if self._errors.is_due():
                log.exception("keeping a generation of the states failed; the service tries again. "
                              "Please report the traceback.")  # fmt: skip
        self._failures = self._failures + 1 if problem else 0
        if not problem:
            self._current_s = time.monotonic()
        if self._failures == FAILURES_TO_LOG:
            # Single failures are normal: an actor may be busy, or a message is between two actors.
            log.warning(
                "no older generation of the states can be kept: %s. A power cut would lose all "
                "keyframes since generation %d. If the disk is full, free some space.",
                problem, self._completed,
            )  # fmt: skip
        return problem

    async def _keep(self, *, is_forced: bool) -> str:
        positions = await asyncio.to_thread(self._read_positions)
        if positions == self._positions and not is_forced:
            return ""
        if not self._is_confirmed:
            self._completed = await asyncio.to_thread(confirm_completed, self._store)
            self._is_confirmed = True
        number = await asyncio.to_thread(next_generation, self._store)
        for actor in self._actors:
            details = number, self._completed
            error = await self._sender.send("keep", actor, self._within_s, details)
            if error:
                self._within_s = min(2 * self._within_s, MAX_KEEP_WITHIN_S)
                return f"{actor} {error}"
        problem = await asyncio.to_thread(
            problem_of_states, self._store, self._actors, number, is_quick=True
        )
        if problem:
            return str(problem)
        self._is_confirmed = False
        await asyncio.to_thread(complete_generation, self._store, number)
        self._completed, self._positions, self._is_confirmed = number, positions, True
        return ""

    def close(self) -> None:
        """Close the client that sends commands to the stages."""
        self._sender.close()

    def _read_positions(self) -> list[str]:
        """Return names of files that change with each message on a lossless topic."""
        contents = [read_contents(self._store.folder / a / CONTENTS) for a in self._actors]
        return [each.files.get(OFFSETS, "") if each else "" for each in contents]


def keep_stopped(
    store: FolderStore, actors: Sequence[str], number: int, completed: int = 0
) -> None:
    """Keep the states of stopped actors as a complete generation.

    A generation is a synced copy of the states of all actors.

    Args:
        store: Store of the states.
        actors: The actors.
        number: Number of the generation; no earlier generation has it.
        completed: Number of the last complete generation; 0 if there is none. That generation is
            not deleted before the new one is complete.

    Raises:
        OSError: The disk is full or cannot be written.
        DataError: A state cannot be read.
    """
    for actor in actors:
        store.keep(actor, number, completed).write()
    complete_generation(store, number)


def keep_last(store: FolderStore, actors: Sequence[str]) -> None:
    """Sync the states of all actors after they have stopped, and keep them as a generation.

    A generation is a copy to which the service can fall back. A power cut after this call loses
    nothing.

    Raises:
        OSError: The disk is full or cannot be written.
        DataError: A state cannot be read, or the states do not belong together.
    """
    for actor in actors:
        SavedFiles(store, actor).sync()
    if problem := problem_of_states(store, actors, is_quick=True):
        raise DataError(str(problem))
    completed = confirm_completed(store)
    keep_stopped(store, actors, next_generation(store), completed)
