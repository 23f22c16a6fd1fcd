"""Store of the last state of each actor in memory."""

from collections.abc import Iterable
from pathlib import Path

from .state_store import State


class MemoryStore:
    """Store in memory; the states are lost when the process ends, but not when an actor fails."""

    # The states do not survive a power cut, and have no generations.
    syncs = has_generations = False

    def __init__(self) -> None:
        self._states: dict[str, State] = {}

    def backlog_folder(self, actor: str) -> None:  # noqa: ARG002
        """Return None, because unhandled messages stay in memory, as the states do."""
        return

    def quarantine_folder(self, actor: str) -> None:  # noqa: ARG002
        """Return None: memory cannot keep a record of messages that end the process."""
        return

    def save(self, actor: str, state: State, unsynced: Iterable[Path] = ()) -> None:  # noqa: ARG002
        """Replace the state of an actor; an empty state is ignored."""
        if state:
            self._states[actor] = dict(state)

    def load(self, actor: str) -> State | None:
        """Return the last state of an actor; None if there is none."""
        return self._states.get(actor)

    def delete(self, actor: str) -> None:
        """Delete the state of an actor."""
        self._states.pop(actor, None)

    def keep(
        self,
        actor: str,  # noqa: ARG002
        generation: int,  # noqa: ARG002
        completed: int,  # noqa: ARG002
        unsynced: Iterable[Path] = (),  # noqa: ARG002
    ) -> None:
        """Keep no generation (synced copy of all states): memory does not survive the process."""
        return

    def is_kept(self, actor: str) -> bool:  # noqa: ARG002
        """Return False, because no generation of the state is kept."""
        return False

    def give_up(self, actor: str) -> None:
        """Do nothing, because no generations exist that could be deleted."""

    def has_fallen_back(self, actor: str) -> bool:  # noqa: ARG002
        """Return False, because no older state is kept that could replace a damaged one."""
        return False
