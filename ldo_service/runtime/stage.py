"""Stage: the runtime around one actor.

For each message, the stage runs the handler in the actor's own thread. It then saves the state of
the actor, sends the outputs in order, and acknowledges the message to its producer.
"""

import asyncio
import logging
from collections.abc import Callable, Iterator, Mapping

from ldo_service.errors import StageStalled
from ldo_service.schemas import Health, Message, encode
from ldo_service.schemas.topics import HEALTH
from ldo_service.storage.memory_store import MemoryStore
from ldo_service.storage.state_store import StateStore
from ldo_service.transport.flow_control import Header, encode_link, new_epoch
from ldo_service.transport.interface import Transport
from ldo_service.transport.worker import Worker

from ._heartbeat import Heartbeat
from .actor import Actor, FlowStatus
from .checkpointer import Checkpointer
from .delivery_state import logged_input
from .inlet import Delivery
from .journal import Journal, Kind, close_journal
from .mailbox import Mailbox
from .outlets import OutletOpener, Outlets
from .quarantine import Quarantine
from .restoring import ActorRestorer, FailureLog
from .stage_commands import CommandReceiver, StageCommand
from .stage_metrics import StageMetrics
from .state_saver import StateSaver, UnsavedStateError
from .step import MessageDecoder, Produced, produce
from .supervision_policy import SupervisionConfig

log = logging.getLogger(__name__)

# Time between two checks for unsaved state and for idle work while no message arrives, seconds.
CHECK_S = 0.5


class Stage:
    """Runtime around one actor.

    If a step fails, the stage restores the actor from its saved state and repeats the step once. It
    discards a message that fails twice. The stage saves the actor's state after each step. It then
    sends the step's outputs to required consumers, and acknowledges the message. While the disk is
    full, most stages take no messages; see `StateSaver`. The `journal` records all that the steps
    depend on.
    """

    def __init__(
        self,
        make: Callable[[], Actor],
        transport: Transport,
        *,
        config: SupervisionConfig | None = None,
        store: StateStore | None = None,
        expected: Mapping[str, frozenset[str]] | None = None,
        with_backlog: Mapping[str, frozenset[str]] | None = None,
        on_evicted: Callable[[str], None] = lambda _consumer: None,
        journal: Journal | None = None,
        heartbeat: Heartbeat | None = None,
        suspects: asyncio.Lock | None = None,
        starts_paused: Callable[[], bool] = lambda: False,
    ) -> None:
        """Create the actor and restore its last saved state.

        Args:
            make: Function that creates a new actor.
            transport: The network.
            config: Limits of supervision.
            store: Storage of the state; in memory by default.
            expected: Required consumers, which must not miss a message, by output topic.
            with_backlog: Required consumers with policy `Backlog`, by output topic.
            on_evicted: Called with the name of an evicted consumer.
            journal: Receiver of the journal entries.
            heartbeat: Heartbeat of this process; None if no parent process reads it.
            suspects: Lock that all stages of this process share; see `Quarantine`.
            starts_paused: Function that returns True if the stage takes no messages until `resume`.
        """
        self._transport, self._starts_paused = transport, starts_paused
        self._config = config = config or SupervisionConfig()
        store = store or MemoryStore()
        self._checkpointer = Checkpointer(store)
        self._opener = OutletOpener(
            transport, config, store, expected or {}, with_backlog or {}, on_evicted
        )
        self._journal = journal or Journal()
        self._metrics = StageMetrics(heartbeat)
        self._restorer = ActorRestorer(
            make, self._checkpointer, self._journal, self._metrics, config
        )
        self._actor = self._restorer.restore()
        self.name = self._actor.name
        self._restorer.open_budget(self.name)
        self._quarantine = Quarantine(store.quarantine_folder(self.name), suspects)
        self._metrics.quarantined = self._quarantine.count
        self._epoch = new_epoch()
        self._drain_requested = self._is_idle_failed = False
        self._failure_log = FailureLog()
        self._mailbox: Mailbox | None = None
        self._reader = MessageDecoder(self.name)
        self._outlets = Outlets()

    # --- life -----------------------------------------------------------------------------------
    async def run(self) -> None:
        """Run the stage until `drain` or cancellation; call this method only once.

        Raises:
            RestartsExhausted: The actor failed more often than its restart budget allows.
            StageStalled: A step took longer than `SupervisionConfig.step_limit` allows.
        """
        nice = 0 if self._actor.is_prompt else self._config.nice
        self._worker = Worker(self.name, nice=nice)
        self._open_outlets()
        self._saver = self._open_saver()
        if self._checkpointer.past.is_none:
            self._saver.save_initial(self._actor)
        self._mailbox = self._saver.mailbox = self._open_mailbox()
        self._transport.declare_liveliness(self.name)
        tasks = {
            asyncio.create_task(self._heartbeat_loop(self._mailbox), name=f"{self.name} heartbeat"),
            asyncio.create_task(self._work(self._mailbox), name=f"{self.name} work"),
        }
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        except asyncio.CancelledError:
            self._quarantine.withdraw()
            raise
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._worker.close()
            self._saver.close()
            self._close_ports(self._mailbox)
            await close_journal(self._journal, self.name)

    def drain(self) -> None:
        """Request a soft stop: handle queued messages, publish final messages, and then end."""
        self._drain_requested = True
        self._metrics.state = "draining"
        if self._mailbox:
            self._mailbox.close()

    def _open_outlets(self) -> None:
        past, source = self._checkpointer.past.outputs, (self.name, self._epoch)
        self._outlets = Outlets(self._opener.open(o, source, past) for o in self._actor.outputs)
        self._health = self._transport.publisher(f"{HEALTH.name}/{self.name}")

    def _open_saver(self) -> StateSaver:
        saved = self._checkpointer, self._worker, self._outlets
        return StateSaver(*saved, self._metrics, self._journal, lambda: self._drain_requested)

    def _open_mailbox(self) -> Mailbox:
        mailbox = Mailbox(
            self.name,
            self._actor.inputs,
            self._transport,
            max_bytes=round(self._config.max_message_mb * 1e6),
            past=self._checkpointer.past.inputs,
            is_held=self._starts_paused(),
        )
        self._commands = CommandReceiver(self.name, self._transport, mailbox.put_command)
        if self._drain_requested:
            mailbox.close()
        else:
            self._metrics.state = "ready"
        return mailbox

    def _close_ports(self, mailbox: Mailbox) -> None:
        mailbox.close()
        mailbox.disconnect()
        self._commands.close()
        self._outlets.close()
        self._health.close()

    # --- work -----------------------------------------------------------------------------------
    async def _work(self, mailbox: Mailbox) -> None:
        try:
            if self._saver.is_unsaved:
                await self._saver.save(self._actor)
            await self._publish_restored()
            while delivery := await self._next(mailbox):
                await self._take(delivery, mailbox)
            await self._publish("finished", lambda: self._actor.on_stop())
            if self._saver.is_unsaved:
                raise UnsavedStateError
            await self._outlets.flush()
        except UnsavedStateError:
            log.error("%s: stopped before its last step was saved. The step is repeated after the "
                      "restart, so nothing is lost. Free some disk space before the restart.",
                      self.name)  # fmt: skip

    async def _next(self, mailbox: Mailbox) -> Delivery | StageCommand | None:
        """Take the next delivery or command; None if the mailbox is closed and empty.

        While none arrives, save an unsaved state, or do idle work of the actor. Idle work starts
        after `Actor.idle_after_s` without a message. Its further steps follow without a pause.
        """
        is_idle = False
        while True:
            is_unsaved = self._saver.is_unsaved
            has_work = not is_unsaved and self._has_idle_work(mailbox)
            idle_wait_s = 0.0 if is_idle else self._actor.idle_after_s
            try:
                return await mailbox.take(idle_wait_s if has_work else CHECK_S)
            except TimeoutError:
                is_idle = has_work
                if is_unsaved:
                    await self._save_and_send([])
                elif has_work:
                    await self._work_idly()

    async def _take(self, delivery: Delivery | StageCommand, mailbox: Mailbox) -> None:
        if isinstance(delivery, StageCommand):
            await self._execute(delivery, mailbox)
            return
        is_due = self._quarantine.is_due(delivery)
        if is_due:
            self._metrics.quarantined = self._quarantine.add(self.name, delivery)
            await self._saver.save(self._actor, delivery)
        message = None if is_due else self._reader.message_of(delivery)
        if message is not None:
            self._journal.record_input(delivery, message.stamp_ns)
            await self._step(message, delivery)
        mailbox.done(delivery, rejected=message is None)

    async def _step(self, message: Message, delivery: Delivery) -> None:
        self._is_idle_failed = False
        for attempt in range(2):
            if await self._try(message, delivery):
                if attempt:
                    self._restorer.charge()  # The message has no fault: its repetition succeeded.
                return
        self._metrics.record_dead_letter()
        self._journal.record_step("dead_lettered", FlowStatus())
        await self._saver.save(self._actor, delivery)
        self._failure_log.dead_lettered(self.name, message, self._metrics.dead_lettered)

    async def _try(self, message: Message, delivery: Delivery) -> bool:
        """Handle a message; return False if the handler failed."""
        what = f"handling {type(message).__name__}"
        produced = await self._attempt(
            lambda: self._actor.handle(message), ("done", "failed"), what, delivery
        )
        if produced is not None:
            self._metrics.record_step(message, bool(produced) or not self._actor.outputs)
        return produced is not None

    def _has_idle_work(self, mailbox: Mailbox) -> bool:
        if self._is_idle_failed or self._drain_requested or mailbox.is_held:
            return False
        self._update_flow_status()  # Idle work may need credit.
        return self._actor.has_idle_work()

    async def _work_idly(self) -> None:
        """Do one step of the actor's idle work; after a failure, wait for the next message."""
        produced = await self._attempt(
            lambda: self._actor.on_idle(), ("idle", "idle_failed"), "idle work"
        )
        self._is_idle_failed = produced is None

    async def _attempt(
        self,
        work: Callable[[], Iterator[Message]],
        kinds: tuple[Kind, Kind],
        what: str,
        delivery: Delivery | None = None,
    ) -> list[Produced] | None:
        """Run a step in the actor's thread, save the state and send the outputs.

        Args:
            work: Handler that yields the messages of the step.
            kinds: Kind of the step's journal entry after a success, and after a failure.
            what: Description of the step for the log.
            delivery: Input of the step; None for idle work.

        Returns:
            The outputs; None if the step failed. The actor is then restored.
        """
        self._update_flow_status()
        try:
            async with self._quarantine.counting(delivery):
                with self._metrics.step():
                    produced = await self._worker.run(lambda: produce(self._actor, work()))
            self._outlets.stage_outputs(produced)
            logged = logged_input(self._actor, delivery)
            is_saved = await self._saver.save(self._actor, delivery, logged)
        except UnsavedStateError:
            raise
        except Exception as error:
            self._failure_log.step_failed(self.name, what, is_of_message=delivery is not None)
            self._journal.record_step(kinds[1], self._actor.situation, error=repr(error))
            await self._restart(is_charged=delivery is None)
            return None
        self._journal.record_step(kinds[0], self._actor.situation, produced)
        await self._outlets.release(is_saved=is_saved)
        return produced

    async def _save_and_send(self, produced: list[Produced], *, whole: bool = False) -> None:
        self._outlets.stage_outputs(produced)
        is_saved = await self._saver.save(self._actor, whole=whole)
        await self._outlets.release(is_saved=is_saved)

    def _update_flow_status(self) -> None:
        self._actor.situation = FlowStatus(
            credits=self._outlets.credits(),
            backlog=self._mailbox.waiting() if self._mailbox else {},
        )

    async def _publish_restored(self) -> None:
        if self._checkpointer.past.of_actor:
            await self._publish("resumed", lambda: self._actor.on_restored())

    async def _publish(self, kind: Kind, messages: Callable[[], Iterator[Message]]) -> None:
        self._update_flow_status()
        try:
            produced = await self._worker.run(lambda: produce(self._actor, messages()))
        except Exception:
            self._metrics.failures += 1
            log.exception("%s: producing the messages of step %r failed; subscribers may miss the "
                          "last state.", self.name, kind)  # fmt: skip
            return
        if produced or kind == "finished":
            self._journal.record_step(kind, self._actor.situation, produced)
        await self._save_and_send(produced, whole=True)

    # --- commands -------------------------------------------------------------------------------
    async def _execute(self, command: StageCommand, mailbox: Mailbox) -> None:
        try:
            match command.what:
                case "pause":
                    mailbox.pause()
                case "resume":
                    mailbox.resume()
                case "reset":
                    await self._reset(mailbox)
                case "save":
                    await self._saver.save_checkpoint(self._actor)
                case "keep":
                    return await self._saver.keep(self._actor, command, self._commands.reply)
        except Exception as error:
            log.exception(
                "%s: command %s failed. Repeat `ldo control %s` or restart the service.",
                self.name, command.what, command.what,
            )  # fmt: skip
            self._commands.reply(command, f"{type(error).__name__}: {error}")
        else:
            self._commands.reply(command, "")

    async def _reset(self, mailbox: Mailbox) -> None:
        """Replace the actor by a new, empty one under a new epoch; other actors connect again."""
        self._checkpointer.forget(self.name)
        self._actor = await self._worker.run(self._restorer.restore)
        self._epoch = new_epoch()
        self._metrics.facts = {}
        mailbox.reset()
        self._outlets.restart_numbering(self._epoch)
        await self._saver.save(self._actor)

    async def _restart(self, *, is_charged: bool) -> None:
        """Restore the actor's last saved state; see `ActorRestorer.restart`."""
        self._actor = await self._restorer.restart(self._worker, is_charged=is_charged)
        self._outlets.discard()
        await self._publish_restored()

    # --- health ---------------------------------------------------------------------------------
    async def _heartbeat_loop(self, mailbox: Mailbox) -> None:
        while True:
            self._metrics.clock.tick(self._config.heartbeat_s)
            try:
                mailbox.send_credits()
                self._outlets.check_windows(self._metrics.clock.now_s())
                header = Header(self.name, self._epoch, 0, self._metrics.last_stamp_ns)
                self._health.post(encode_link(header), encode(self.health()))
            except Exception:
                # A heartbeat only reports on the actor, so a failed heartbeat must not end the
                # actor.
                self._metrics.failures += 1
                log.exception("%s: a heartbeat failed; the actor continues. Please report the "
                              "traceback.", self.name)  # fmt: skip
            limit_s, setting = self._config.step_limit(self._actor.is_backend)
            if self._metrics.busy_s > limit_s:
                raise StageStalled(self.name, self._metrics.busy_s, setting)
            await asyncio.sleep(self._config.heartbeat_s)

    def health(self) -> Health:
        """Return the current health message."""
        return self._metrics.health(
            actor=self.name,
            epoch=self._epoch,
            paused=self._mailbox is not None and self._mailbox.is_held,
            inputs=self._mailbox.counts() if self._mailbox else (),
            outputs=self._outlets.counts(),
        )
