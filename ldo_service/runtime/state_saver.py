"""Saving of a stage's state after each step, with retries while the disk is full."""

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path

from ldo_service.errors import DataError
from ldo_service.storage.atomic_write import sync_all
from ldo_service.storage.generation_files import GenerationFiles
from ldo_service.storage.state_store import State
from ldo_service.transport.worker import Worker

from .actor import Actor, Lossless
from .checkpointer import Checkpointer
from .delivery_state import LoggedInput
from .inlet import Delivery
from .journal import Journal
from .mailbox import Mailbox
from .outlets import Outlets
from .stage_commands import StageCommand
from .stage_metrics import StageMetrics
from .supervision_policy import LOG_PERIOD_S, LogLimit

log = logging.getLogger(__name__)

# Time between two attempts to save, seconds. A user who frees disk space hardly waits, and the
# attempts take little time.
SAVE_AGAIN_S = 0.5


class UnsavedStateError(Exception):
    """Error that ends a stage whose last step is not saved; a restarted stage repeats the step."""


class StateSaver:
    """Saver of the state of one stage.

    While the disk is full, the saver retries, and the stage takes no messages. Two kinds of stages
    take messages nevertheless. Both have no lossless input:

    - A stage with a nonblocking output (`Out.is_nonblocking`). It holds its messages for required
      consumers until its state is saved. Meanwhile, `Actor.has_credit` is False for their topics.
    - A stage whose outputs have no required consumer.

    A stage that is about to end does not wait for space on the disk.
    """

    def __init__(
        self,
        checkpointer: Checkpointer,
        worker: Worker,
        outlets: Outlets,
        metrics: StageMetrics,
        journal: Journal,
        is_draining: Callable[[], bool],
    ) -> None:
        """Initialize without a mailbox; the stage sets `mailbox` once it is open.

        Args:
            checkpointer: Writer of the state.
            worker: The actor's thread.
            outlets: Outputs of the stage, whose positions are saved.
            metrics: Counters of the stage; every save updates the actor's metrics in this object.
            journal: Journal of the stage, for its metrics.
            is_draining: Function that returns True if the stage is about to end.
        """
        self._checkpointer, self._worker, self._outlets = checkpointer, worker, outlets
        self._metrics, self._journal = metrics, journal
        self._is_draining = is_draining
        self.mailbox: Mailbox | None = None
        self._failures = LogLimit(LOG_PERIOD_S)
        self._syncing: set[asyncio.Task[None]] = set()
        self._unsynced: set[Path] = set()  # Files of outboxes whose last sync has not succeeded.

    @property
    def is_unsaved(self) -> bool:
        """True if the last step is not saved."""
        return self._checkpointer.is_unsaved

    def save_initial(self, actor: Actor) -> None:
        """Save the initial state before other actors connect.

        The initial state is small, so this call blocks the event loop only briefly. If the state
        cannot be written, the stage retries before the first step.
        """
        try:
            self._write(
                actor, self._checkpointer.build_checkpoint(actor, self._links(), None, False)
            )
        except OSError as error:
            self._record_failure(actor, error)

    async def save(
        self,
        actor: Actor,
        delivery: Delivery | None = None,
        taken: LoggedInput | None = None,
        *,
        whole: bool = False,
    ) -> bool:
        """Save the current state; most stages retry while the disk is full.

        Args:
            actor: The actor of the stage.
            delivery: The message of the current step, which is saved as handled.
            taken: Entry of this message in the write-ahead log; None unless `Actor.lags`.
            whole: Save the complete state (`Actor.checkpoint`), not the result of `Actor.snapshot`.

        Returns:
            True if the state is saved. False if the disk is full and the stage takes messages
            nevertheless; see `StateSaver`.

        Raises:
            UnsavedStateError: The stage is about to end and the state cannot be written.
            Exception: Any exception of the actor's `snapshot` or `checkpoint`.
        """
        state = await self._worker.run(
            self._checkpointer.build_checkpoint, actor, self._links(delivery), taken, whole
        )
        while not await self._is_written(actor, state):
            if not self._waits_for_disk(actor):
                return False
            if self._is_draining():
                raise UnsavedStateError
            await asyncio.sleep(SAVE_AGAIN_S)
        return True

    async def save_checkpoint(self, actor: Actor) -> None:
        """Save the complete state (`Actor.checkpoint`) once, without retries.

        Raises:
            OSError: The state cannot be written.
            Exception: Any exception of the actor's `checkpoint`.
        """
        await self._worker.run(self._write_checkpoint, actor, self._links())

    async def keep(
        self, actor: Actor, command: StageCommand, reply: Callable[[StageCommand, str], None]
    ) -> None:
        """Copy the last saved state for a generation, and write the copy in the background.

        A generation has copies of the states of all actors, and the service can fall back to it.
        The call fails while the copy for the previous generation is still being written.

        Args:
            actor: The actor of the stage.
            command: The command, with the number of the generation.
            reply: Function that sends the reply to the command. It is called with the command and
                an error message; the message is empty after the copy is written.
        """
        if self._syncing:
            reply(command, "is still writing the previous generation")
            return
        generation = command.generation, command.completed
        is_previous_complete = self._checkpointer.is_last_kept(command.completed)
        try:
            files, paths = await self._worker.run(self._checkpointer.keep, actor, *generation)
        except (OSError, DataError) as error:
            reply(command, f"cannot keep its state: {error}")
            return
        self._outlets.keep(is_previous_complete=is_previous_complete)
        self._unsynced.update(self._outlets.pop_unsynced())
        paths += sorted(self._unsynced)
        task = asyncio.create_task(self._write_generation(files, paths, command, reply))
        self._syncing.add(task)
        task.add_done_callback(self._syncing.discard)

    async def _write_generation(
        self,
        files: GenerationFiles | None,
        paths: list[Path],
        command: StageCommand,
        reply: Callable[[StageCommand, str], None],
    ) -> None:
        try:
            await asyncio.to_thread(sync_all, paths)
            self._unsynced.clear()
            if files is not None:
                await asyncio.to_thread(files.write)
        except (OSError, DataError) as error:
            reply(command, f"cannot keep its state: {error}")
        except Exception as error:  # The service waits for a reply.
            log.exception("keeping a state failed. Please report the traceback.")
            reply(command, f"cannot keep its state: {error!r}")
        else:
            reply(command, "")

    def close(self) -> None:
        """Cancel the writing that `keep` began; the service gets no reply to the command `keep`."""
        for task in self._syncing:
            task.cancel()

    def _links(self, delivery: Delivery | None = None) -> State:
        inputs = self.mailbox.past(delivery) if self.mailbox else self._checkpointer.past.inputs
        return self._checkpointer.links(inputs, self._outlets.past())

    async def _is_written(self, actor: Actor, state: State) -> bool:
        try:
            await self._worker.run(self._write, actor, state)
        except OSError as error:
            self._record_failure(actor, error)
        if self.mailbox:
            self.mailbox.waits_for_disk = self._checkpointer.is_unsaved
        return not self._checkpointer.is_unsaved

    def _waits_for_disk(self, actor: Actor) -> bool:
        takes = any(isinstance(port.policy, Lossless) for port in actor.inputs)
        return takes or (self._outlets.has_required_consumers and not self._outlets.is_nonblocking)

    def _record_failure(self, actor: Actor, error: OSError) -> None:
        self._metrics.failures += self._checkpointer.record_failure(actor.name, error)
        self._metrics.facts = {**self._metrics.facts, **self._checkpointer.metrics()}

    # --- in the actor's thread ------------------------------------------------------------------
    def _write(self, actor: Actor, state: State) -> None:
        self._outlets.store()  # First, because the state refers to the messages in backlogs.
        self._checkpointer.write(actor, state)
        try:
            self._checkpointer.notify(actor)
            self._update_metrics(actor)
        except Exception:  # The step is saved: an exception must not repeat it.
            self._metrics.failures += 1
            if self._failures.is_due():
                log.exception("%s: an error after saving a step; the step counts. Please report "
                              "the traceback.", actor.name)  # fmt: skip

    def _update_metrics(self, actor: Actor) -> None:
        self._metrics.facts = {
            **actor.metrics(),
            **self._journal.metrics(),
            **self._checkpointer.metrics(),
        }

    def _write_checkpoint(self, actor: Actor, links: State) -> None:
        self._write(actor, self._checkpointer.build_checkpoint(actor, links, None, True))
