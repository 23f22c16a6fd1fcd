"""Store that holds the last state of each actor in memory."""

from collections.abc import Iterable
from pathlib import Path

from .state_store import State


class MemoryStore:
    """Store of states in memory; they outlive a failure of their actor, but not the process."""

    # The states do not survive a power cut, and have no generations.
    syncs = has_generations = False

    def __init__(self) -> None:
        self._states: dict[str, State] = {}

    def backlog_folder(self, actor: str) -> None:  # noqa: ARG002
        """Return None, because unhandled messages stay in memory, as the states do."""
        return

    def quarantine_folder(self, actor: str) -> None:  # noqa: ARG002
        """Return None, because messages that end the process cannot be kept in its memory."""
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
        """Do nothing, because a store in memory has no generations (copies of states on disk)."""
        return

    def is_kept(self, actor: str) -> bool:  # noqa: ARG002
        """Return False, because a store in memory keeps no older copies of the states."""
        return False

    def give_up(self, actor: str) -> None:
        """Do nothing, because a store in memory has no older copies of the states to delete."""

    def has_fallen_back(self, actor: str) -> bool:  # noqa: ARG002
        """Return False, because this store has no older states that could replace damaged ones."""
        return False
