"""Runs one actor: take, handle in its own thread, save, send in order, acknowledge."""

import asyncio
import logging
from collections.abc import Callable, Iterator, Mapping

from ldo_service.errors import StageStalled
from ldo_service.schemas import Health, Message, encode
from ldo_service.schemas.topics import HEALTH
from ldo_service.storage.state_store import MemoryStore, State, StateStore
from ldo_service.transport.flow_control import Header, encode_link, new_epoch
from ldo_service.transport.interface import Transport
from ldo_service.transport.worker import Worker

from .actor import Actor, FlowStatus, Lossless
from .checkpointer import Checkpointer
from .delivery_state import LoggedInput
from .inlet import Delivery
from .journal import Journal, Kind
from .mailbox import Mailbox
from .outlet import Outlet, Outlets
from .stage_commands import CommandReceiver, StageCommand
from .stage_metrics import StageMetrics
from .step import MessageDecoder, Produced, produce
from .supervision_policy import RestartBudget, SupervisionConfig

log = logging.getLogger(__name__)


class UnsavedStateError(Exception):
    """A stage is to end, and the disk takes nothing: what it did last will be done again."""


class Stage:
    """`run` until `drain` or cancelled.

    A failed step is tried once more by a successor that starts from the last state; a message that
    fails twice is set aside and counted. `expected` names, for each output topic, the consumers
    that must not miss a message. Everything that a step depends on is told to the `journal`.

    A step counts when it is saved: only then is what it made for such consumers sent, and what it
    took acknowledged. While the disk takes nothing the stage tries again and does no more steps.
    One whose outputs never wait goes on, makes nothing for them, and sends what it made once it is
    saved; one without such neighbours goes on too. One that is to end does not wait for a disk.
    """

    JOURNAL_WITHIN_S = 5.0  # a stage that ends waits so long for its journal to be written
    SAVE_AGAIN_S = 0.5  # after a failed save: soon enough for who frees a disk, and no load

    def __init__(
        self,
        make: Callable[[], Actor],
        transport: Transport,
        *,
        config: SupervisionConfig | None = None,
        store: StateStore | None = None,
        expected: Mapping[str, frozenset[str]] | None = None,
        on_evicted: Callable[[str], None] = lambda _consumer: None,
        journal: Journal | None = None,
    ) -> None:
        self._make, self._transport = make, transport
        self._config = config = config or SupervisionConfig()
        self._checkpointer = Checkpointer(store or MemoryStore())
        self._expected = expected or {}
        self._on_evicted = on_evicted
        self._journal = journal or Journal()
        self._actor = self._restored_actor()
        self.name = self._actor.name
        self._epoch = new_epoch()
        self._metrics = StageMetrics()
        self._budget = RestartBudget(
            self.name,
            config.max_restarts,
            config.restart_window_s,
            config.restart_delay_s,
            config.restart_delay_max_s,
        )
        self._drain_requested = False
        self._mailbox: Mailbox | None = None
        self._reader = MessageDecoder(self.name)
        self._outlets = Outlets()

    # --- life -----------------------------------------------------------------------------------
    async def run(self) -> None:
        """Once. Raises RestartsExhausted or StageStalled when it gives up."""
        nice = 0 if self._actor.is_prompt else self._config.nice
        self._worker = Worker(self.name, nice=nice)
        self._open_outlets()
        if self._checkpointer.past.is_none:
            self._begin()
        self._mailbox = self._open_mailbox()
        self._transport.declare_liveliness(self.name)
        tasks = {
            asyncio.create_task(self._heartbeat_loop(self._mailbox), name=f"{self.name} heartbeat"),
            asyncio.create_task(self._work(self._mailbox), name=f"{self.name} work"),
        }
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._worker.close()
            self._close_ports(self._mailbox)
            await self._close_journal()

    def drain(self) -> None:
        """Soft stop: handle what has arrived, say the last words, end."""
        self._drain_requested = True
        self._metrics.state = "draining"
        if self._mailbox:
            self._mailbox.close()

    def _open_outlets(self) -> None:
        self._outlets = Outlets(
            Outlet(
                port,
                self.name,
                self._epoch,
                self._transport,
                self._expected.get(port.topic.name, ()),
                self._config.evict_after_s,
                self._on_evicted,
                self._checkpointer.past.outputs.get(port.topic.name),
            )
            for port in self._actor.outputs
        )
        self._health = self._transport.publisher(f"{HEALTH.name}/{self.name}")

    def _open_mailbox(self) -> Mailbox:
        mailbox = Mailbox(
            self.name,
            self._actor.inputs,
            self._transport,
            max_bytes=round(self._config.max_message_mb * 1e6),
            past=self._checkpointer.past.inputs,
        )
        self._orders = CommandReceiver(self.name, self._transport, mailbox.put_command)
        if self._drain_requested:
            mailbox.close()
        else:
            self._metrics.state = "ready"
        return mailbox

    def _close_ports(self, mailbox: Mailbox) -> None:
        mailbox.close()
        mailbox.disconnect()
        self._orders.close()
        self._outlets.close()
        self._health.close()

    async def _close_journal(self) -> None:
        written = asyncio.wrap_future(self._journal.close())
        done, _ = await asyncio.wait({written}, timeout=self.JOURNAL_WITHIN_S)
        if not done:
            written.cancel()
            log.error("%s: the end of its recording is not written", self.name)

    # --- work -----------------------------------------------------------------------------------
    async def _work(self, mailbox: Mailbox) -> None:
        try:
            if self._checkpointer.is_unsaved:
                await self._save()
            await self._outlets.release()  # what a predecessor made
            await self._publish_restored()
            while delivery := await self._next(mailbox):
                await self._take(delivery, mailbox)
            await self._publish_final()
            if self._checkpointer.is_unsaved:
                raise UnsavedStateError
            await self._outlets.flush()
        except UnsavedStateError:
            log.error("%s ends and its last step is not saved: it will be done again", self.name)

    async def _next(self, mailbox: Mailbox) -> Delivery | StageCommand | None:
        """While something is not saved, it is tried again meanwhile."""
        while self._checkpointer.is_unsaved:
            try:
                return await asyncio.wait_for(mailbox.take(), self.SAVE_AGAIN_S)
            except TimeoutError:
                await self._tell([])
        return await mailbox.take()

    async def _take(self, delivery: Delivery | StageCommand, mailbox: Mailbox) -> None:
        if isinstance(delivery, StageCommand):
            await self._execute(delivery, mailbox)
            return
        message = self._reader.message_of(delivery)
        if message is not None:
            self._journal.record_input(delivery, message.stamp_ns)
            await self._step(message, delivery)
        mailbox.done(delivery, rejected=message is None)

    async def _step(self, message: Message, delivery: Delivery) -> None:
        for _attempt in range(2):
            if await self._try(message, delivery):
                return
        self._metrics.dead_lettered += 1
        self._journal.record_step("dead_lettered", FlowStatus())
        await self._save(delivery)
        log.error(
            "%s: %s of stamp %d failed twice and is set aside",
            self.name, type(message).__name__, message.stamp_ns,
        )  # fmt: skip

    async def _try(self, message: Message, delivery: Delivery) -> bool:
        """Handle, save, send; False when it failed and a successor is in place."""
        self._update_flow_status()
        try:
            with self._metrics.step():
                produced = await self._worker.run(self._handle, message)
            self._outlets.hold(produced)
            is_saved = await self._save(delivery, self._taken(delivery))
        except UnsavedStateError:
            raise
        except Exception as error:
            log.exception("%s failed on %s", self.name, type(message).__name__)
            self._journal.record_step("failed", self._actor.situation, error=repr(error))
            await self._restart()
            return False
        self._journal.record_step("done", self._actor.situation, produced)
        await self._outlets.release(is_saved=is_saved)
        self._metrics.record_step(message, is_timed=bool(produced) or not self._actor.outputs)
        return True

    def _taken(self, delivery: Delivery) -> LoggedInput | None:
        """For an actor whose state lags."""
        if not self._actor.lags:
            return None
        return LoggedInput.of(delivery.port.topic.name, delivery.body, self._actor.situation)

    async def _tell(self, produced: list[Produced], *, whole: bool = False) -> None:
        self._outlets.hold(produced)
        await self._outlets.release(is_saved=await self._save(whole=whole))

    def _update_flow_status(self) -> None:
        self._actor.situation = FlowStatus(
            credits=self._outlets.room(),
            backlog=self._mailbox.waiting() if self._mailbox else {},
        )

    async def _publish_restored(self) -> None:
        if self._checkpointer.past.of_actor:
            await self._say("resumed", lambda: self._actor.on_restored())

    async def _publish_final(self) -> None:
        await self._say("finished", lambda: self._actor.on_stop())

    async def _say(self, kind: Kind, words: Callable[[], Iterator[Message]]) -> None:
        self._update_flow_status()
        try:
            produced = await self._worker.run(lambda: produce(self._actor, words()))
        except Exception:
            self._metrics.failures += 1
            log.exception("%s: what it says when it has %s failed", self.name, kind)
            return
        if produced or kind == "finished":
            self._journal.record_step(kind, self._actor.situation, produced)
        await self._tell(produced, whole=True)

    # --- keeping --------------------------------------------------------------------------------
    async def _save(
        self,
        delivery: Delivery | None = None,
        taken: LoggedInput | None = None,
        whole: bool = False,
    ) -> bool:
        """Save all as of now, that delivery handled. False: not yet, and nobody waits for it.

        Raises what the actor raises when it is asked for its state, and LeftUnsaved when the stage
        is to end and the disk takes nothing.
        """
        state = await self._worker.run(
            self._checkpointer.build_checkpoint, self._actor, self._links(delivery), taken, whole
        )
        while not await self._is_written(state):
            if not self._waits_for_disk:
                return False
            if self._drain_requested:
                raise UnsavedStateError
            await asyncio.sleep(self.SAVE_AGAIN_S)
        return True

    async def _is_written(self, state: State) -> bool:
        try:
            await self._worker.run(self._write, state)
        except OSError as error:
            self._note_unsaved(error)
        if self._mailbox:
            self._mailbox.waits_for_disk = self._checkpointer.is_unsaved
        return not self._checkpointer.is_unsaved

    @property
    def _waits_for_disk(self) -> bool:
        takes = any(isinstance(port.policy, Lossless) for port in self._actor.inputs)
        return not self._outlets.is_nonblocking and (takes or self._outlets.has_required_consumers)

    def _begin(self) -> None:
        """Save what there is before anyone counts on this stage: at once, as it is little. What the
        disk does not take is tried again before the first step."""
        try:
            self._write(
                self._checkpointer.build_checkpoint(self._actor, self._links(), None, False)
            )
        except OSError as error:
            self._note_unsaved(error)

    def _links(self, delivery: Delivery | None = None) -> State:
        inputs = self._mailbox.past(delivery) if self._mailbox else self._checkpointer.past.inputs
        return self._checkpointer.links(inputs, self._outlets.past())

    def _note_unsaved(self, error: OSError) -> None:
        self._metrics.failures += self._checkpointer.record_failure(self.name, error)
        self._metrics.facts = {**self._metrics.facts, **self._checkpointer.metrics()}

    # --- orders ---------------------------------------------------------------------------------
    async def _execute(self, order: StageCommand, mailbox: Mailbox) -> None:
        try:
            match order.what:
                case "pause":
                    mailbox.pause()
                case "resume":
                    mailbox.resume()
                case "reset":
                    await self._renew(mailbox)
                case "save":
                    await self._worker.run(self._save_whole, self._links())
        except Exception as error:
            log.exception("%s could not %s", self.name, order.what)
            self._orders.report(order, f"{type(error).__name__}: {error}")
        else:
            self._orders.report(order, "")

    async def _renew(self, mailbox: Mailbox) -> None:
        """Begin anew; to everyone else it looks like a process that was started again."""
        self._checkpointer.forget(self.name)
        self._actor = await self._worker.run(self._restored_actor)
        self._epoch = new_epoch()
        self._metrics.facts = {}
        mailbox.reset()
        self._outlets.renew(self._epoch)
        await self._save()

    # --- in the actor's thread ------------------------------------------------------------------
    def _handle(self, message: Message) -> list[Produced]:
        return produce(self._actor, self._actor.handle(message))

    def _restored_actor(self) -> Actor:
        actor = self._checkpointer.restore_actor(self._make)
        self._journal.record_start(self._checkpointer.past.of_actor or None)
        return actor

    def _write(self, state: State) -> None:
        self._checkpointer.write(self._actor, state)
        self._metrics.facts = {
            **self._actor.metrics(),
            **self._journal.metrics(),
            **self._checkpointer.metrics(),
        }

    def _save_whole(self, links: State) -> None:
        self._write(self._checkpointer.build_checkpoint(self._actor, links, None, True))

    async def _restart(self) -> None:
        """Wait, longer with each failure, and put a successor in place."""
        while True:
            self._metrics.failures += 1
            await asyncio.sleep(self._budget.record_failure(asyncio.get_running_loop().time()))
            try:
                self._actor = await self._worker.run(self._restored_actor)
            except Exception:
                log.exception("%s cannot go on from its last state", self.name)
                continue
            self._metrics.restarts += 1
            self._outlets.take_back()
            await self._publish_restored()
            return

    # --- health ---------------------------------------------------------------------------------
    async def _heartbeat_loop(self, mailbox: Mailbox) -> None:
        while True:
            mailbox.send_credits()
            self._outlets.check_windows()
            header = Header(self.name, self._epoch, 0, self._metrics.last_stamp_ns)
            self._health.post(encode_link(header), encode(self.health()))
            if self._metrics.busy_s > self._config.stall_after_s:
                raise StageStalled(self.name, self._metrics.busy_s)
            await asyncio.sleep(self._config.heartbeat_s)

    def health(self) -> Health:
        """How it is now; also sent with every heartbeat."""
        return self._metrics.health(
            actor=self.name,
            epoch=self._epoch,
            paused=self._mailbox is not None and self._mailbox.is_held,
            inputs=self._mailbox.counts() if self._mailbox else (),
            outputs=self._outlets.counts(),
        )
