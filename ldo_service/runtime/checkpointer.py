"""Saves what a successor needs, in one write, and counts when it cannot."""

import logging
from collections.abc import Callable, Mapping

from ldo_service.storage.state_store import State, StateStore
from ldo_service.transport.flow_control import InletPosition, OutletPosition

from .actor import Actor
from .delivery_state import DeliveryState, LoggedInput, RestoredState, restore_actor

log = logging.getLogger(__name__)


class Checkpointer:
    """Of one stage: `build_checkpoint` and `write` run in its actor's thread."""

    def __init__(self, store: StateStore) -> None:
        self._store, self._ledger = store, DeliveryState()
        self.past = RestoredState()
        self.is_unsaved = False  # the last step
        self._failed = 0

    def restore_actor(self, make: Callable[[], Actor]) -> Actor:
        """An actor that goes on from what was saved last."""
        fresh = make()
        self.past = RestoredState.of(self._store.load(fresh.name))
        if self.past.of_actor:
            log.info("%s goes on from its last state", fresh.name)
        return restore_actor(fresh, self.past, make)

    def forget(self, name: str) -> None:
        """Begin anew."""
        self._store.delete(name)
        self._ledger = DeliveryState()

    def links(
        self, inputs: Mapping[str, InletPosition], outputs: Mapping[str, OutletPosition | None]
    ) -> State:
        """Where the stage stands; None: nobody is expected there."""
        return self._ledger.links(
            inputs, {topic: past for topic, past in outputs.items() if past is not None}
        )

    def build_checkpoint(
        self, actor: Actor, links: State, taken: LoggedInput | None, whole: bool
    ) -> State:
        """`taken`: what a lagging actor took last; `whole`: with nothing left for later."""
        is_whole = whole or self._ledger.is_long
        own = actor.checkpoint() if is_whole else actor.snapshot()
        return {**self._ledger.own(own, taken, is_whole), **links}

    def write(self, actor: Actor, state: State) -> None:
        self._store.save(actor.name, state)
        actor.on_saved()
        if self.is_unsaved:
            self.is_unsaved = False
            log.info("%s is saved again", actor.name)

    def record_failure(self, name: str, error: OSError) -> bool:
        """Count a save that failed; whether it is the first since one succeeded, which is said."""
        self._failed += 1
        is_first, self.is_unsaved = not self.is_unsaved, True
        if is_first:
            log.error(
                "%s: its last step cannot be saved: %r. It tries again, and nothing is mapped that "
                "a kill would lose: free some disk space, or choose another folder with --state.",
                name, error,
            )  # fmt: skip
        return is_first

    def metrics(self) -> dict[str, float]:
        """Nothing where every save succeeded."""
        if not self._failed:
            return {}
        return {"checkpoint_failing": float(self.is_unsaved), "checkpoints_failed": self._failed}
