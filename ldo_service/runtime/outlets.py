"""Outlets of one actor; each outlet sends the messages of one topic to its consumers."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ldo_service.schemas import Message, OutputCount
from ldo_service.schemas.topics import Topic
from ldo_service.storage.message_log import MessageLog
from ldo_service.storage.state_store import StateStore
from ldo_service.transport.flow_control import OutletPosition
from ldo_service.transport.interface import Transport

from .actor import Out
from .outbox import Outbox
from .outlet import Outlet
from .step import Produced
from .supervision_policy import SupervisionConfig


@dataclass(frozen=True, slots=True)
class OutletOpener:
    """Factory of the outlets of a stage. An outlet is the sending half of a topic.

    Each outlet continues the message numbers of the actor's previous process.

    Attributes:
        transport: The network.
        config: Limits of supervision.
        store: Storage of the state. Unhandled messages for consumers with policy `Backlog` are on
            disk if the state is on disk, else in memory.
        expected: Names of the required consumers, by topic name.
        with_backlog: Names of the required consumers with policy `Backlog`, by topic name.
        on_evicted: Called with the name of an evicted consumer.
    """

    transport: Transport
    config: SupervisionConfig
    store: StateStore
    expected: Mapping[str, frozenset[str]]
    with_backlog: Mapping[str, frozenset[str]]
    on_evicted: Callable[[str], None]

    def open(
        self, port: Out, source: tuple[str, int], past: Mapping[str, OutletPosition]
    ) -> Outlet:
        """Open the outlet of a port.

        Args:
            port: The output of the actor.
            source: Name of the actor, and the epoch, a number that identifies a numbering of
                messages. The epoch is used only if `past` has no position for the topic.
            past: Saved position of each outlet of the previous process, by topic name.
        """
        name, epoch = source
        topic = port.topic.name
        position = past.get(topic, OutletPosition(epoch, 0))
        with_backlog = self.with_backlog.get(topic, frozenset())
        return Outlet(
            port,
            name,
            epoch,
            self.transport,
            self.expected.get(topic, frozenset()),
            self.config.evict_after_s,
            self.on_evicted,
            position,
            with_backlog=with_backlog,
            outbox=self._outbox(name, port.topic, position, is_logged=bool(with_backlog)),
        )

    def _outbox(
        self, source: str, topic: Topic, past: OutletPosition, *, is_logged: bool
    ) -> Outbox:
        is_kept = self.store.is_kept(source)
        if not is_logged:
            retained_from = past.handled if is_kept else None
            return Outbox(past.unhandled, retained_from=retained_from)
        max_bytes = round(self.config.backlog_mb * 1e6)
        folder = self.store.backlog_folder(source)
        if folder is None:
            return Outbox(past.unhandled, max_bytes=max_bytes)
        log = MessageLog(
            folder / topic.name.replace("/", "."),
            past.epoch,
            past.handled,
            past.seq,
            max_bytes=max_bytes,
            syncs=self.store.syncs,
        )
        # The consumers keep their states for the first generation before this producer does, so it
        # must still have the messages that they handle meanwhile.
        retained_from = past.handled if is_kept or self.store.has_generations else None
        return Outbox(log=log, retained_from=retained_from, is_kept=is_kept)


class Outlets:
    """Set of all outlets of an actor.

    `stage_outputs` takes the outputs of a step. `release` sends them after the step is saved, and
    `discard` deletes them if the step fails.
    """

    def __init__(self, outlets: Iterable[Outlet] = ()) -> None:
        self._all = {outlet.topic.message: outlet for outlet in outlets}

    def __getitem__(self, message: type[Message]) -> Outlet:
        return self._all[message]

    @property
    def is_nonblocking(self) -> bool:
        """True if at least one output port is nonblocking."""
        return any(outlet.port.is_nonblocking for outlet in self._all.values())

    @property
    def has_required_consumers(self) -> bool:
        """True if at least one topic has a required consumer, which must not miss a message."""
        return any(outlet.position() for outlet in self._all.values())

    def credits(self) -> dict[Topic, int]:
        """Return the number of messages that each nonblocking port may send now, by topic."""
        return {
            outlet.topic: outlet.credits()
            for outlet in self._all.values()
            if outlet.port.is_nonblocking
        }

    def past(self) -> dict[str, OutletPosition | None]:
        """Return the position of each outlet, to be saved with the state of the actor.

        Returns:
            The result of `Outlet.position` by topic name; None for a topic that has no required
            consumer.
        """
        return {outlet.topic.name: outlet.position() for outlet in self._all.values()}

    def stage_outputs(self, produced: Sequence[Produced]) -> None:
        """Assign numbers to the outputs of a step, and hold them until `release` or `discard`."""
        for out in produced:
            self._all[type(out.message)].stage_message(out.message, out.body)

    async def release(self, *, is_saved: bool = True) -> None:
        """Send the outputs of a step that `stage_outputs` holds.

        Args:
            is_saved: Whether the step is saved. If it is not, outputs on topics with required
                consumers are not sent yet.
        """
        for outlet in self._all.values():
            if is_saved or outlet.position() is None:
                await outlet.commit()

    def store(self) -> None:
        """Write unhandled messages to the outboxes on disk; may be called on any thread.

        Raises:
            OSError: The disk is full or cannot be written.
        """
        for outlet in self._all.values():
            outlet.store()

    def discard(self) -> None:
        """Discard the outputs that `stage_outputs` holds."""
        for outlet in self._all.values():
            outlet.rollback()

    async def flush(self) -> None:
        """Wait until the consumers of all topics have received all messages; see `Outlet.flush`."""
        for outlet in self._all.values():
            await outlet.flush()

    def restart_numbering(self, epoch: int) -> None:
        """Restart the message numbers of all topics at 0.

        Args:
            epoch: Number that identifies the new numbering.
        """
        for outlet in self._all.values():
            outlet.reset(epoch)

    def keep(self, *, is_previous_complete: bool) -> None:
        """Retain the messages that consumers need if the service falls back to older states.

        See `Outbox.keep`.

        Args:
            is_previous_complete: Whether the previous generation is complete. A generation has
                copies of the states of all actors.
        """
        for outlet in self._all.values():
            outlet.outbox.keep(outlet.handled, is_previous_complete=is_previous_complete)

    def pop_unsynced(self) -> list[Path]:
        """Return the files and folders of the outboxes that the caller must sync to the disk."""
        return [path for outlet in self._all.values() for path in outlet.outbox.pop_unsynced()]

    def check_windows(self, now_s: float) -> None:
        """Evict every consumer whose window of unhandled messages has been full for too long.

        Args:
            now_s: Current time of the stage's `RunningClock`, seconds.
        """
        for outlet in self._all.values():
            outlet.evict_stalled(now_s)

    def counts(self) -> tuple[OutputCount, ...]:
        """Return the message counters of each output, for the health message of the stage."""
        return tuple(outlet.counts() for outlet in self._all.values())

    def close(self) -> None:
        """Close all outlets."""
        for outlet in self._all.values():
            outlet.close()
