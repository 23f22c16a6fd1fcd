"""Restoration of an actor after a failure, and the log of failures."""

import asyncio
import logging
from collections.abc import Callable

from ldo_service.errors import DamagedStateError
from ldo_service.schemas import Message
from ldo_service.transport.worker import Worker

from .actor import Actor
from .checkpointer import Checkpointer
from .journal import Journal
from .stage_metrics import StageMetrics
from .supervision_policy import LOG_PERIOD_S, LogLimit, RestartBudget, SupervisionConfig

log = logging.getLogger(__name__)


class ActorRestorer:
    """Restorer of an actor's last saved state after a failure, within a restart budget."""

    def __init__(
        self,
        make: Callable[[], Actor],
        checkpointer: Checkpointer,
        journal: Journal,
        metrics: StageMetrics,
        config: SupervisionConfig,
    ) -> None:
        self._make, self._checkpointer, self._journal = make, checkpointer, journal
        self._metrics, self._config = metrics, config

    def restore(self) -> Actor:
        """Return a new actor with the last saved state."""
        self._journal.record_files()  # First, because the new actor changes these files.
        actor = self._checkpointer.restore_actor(self._make)
        self._journal.record_start(self._checkpointer.past.of_actor or None)
        return actor

    def open_budget(self, name: str) -> None:
        """Create the restart budget of the actor with this name."""
        self._name, self._budget = name, RestartBudget.of(name, self._config)

    def charge(self) -> None:
        """Count a failure in the restart budget.

        Raises:
            RestartsExhausted: The budget is used up.
        """
        self._budget.record_failure(asyncio.get_running_loop().time())

    async def restart(self, worker: Worker, *, is_charged: bool) -> Actor:
        """Return the restored actor, after a delay that doubles with each failure.

        A failure to handle a message is not charged, because a message that always fails must not
        use up the restart budget. The stage handles the message again. If that succeeds, the
        message was not the cause, and the stage charges the failure by `charge`.

        Args:
            worker: Thread of the actor.
            is_charged: Whether the failure counts in the restart budget.

        Raises:
            RestartsExhausted: The budget is used up.
            DamagedStateError: The saved state is damaged.
        """
        while True:
            self._metrics.failures += 1
            now_s = asyncio.get_running_loop().time()
            record = self._budget.record_failure if is_charged else self._budget.delay_s
            await asyncio.sleep(record(now_s))
            try:
                actor = await worker.run(self.restore)
            except DamagedStateError as error:
                raise DamagedStateError(
                    f"{error}. Start the service again: it then falls back to an older copy of the "
                    "states of all actors, if there is one."
                ) from error
            except Exception:
                log.exception(
                    "%s: restoring its last state failed; retrying within the restart budget. If "
                    "the service ends, start with an empty map in another folder (--state).",
                    self._name,
                )
                is_charged = True  # A failed restore is no fault of a message.
                continue
            self._metrics.restarts += 1
            return actor


class FailureLog:
    """Log of failed steps, with at most one line per minute about failed messages.

    Any program may send messages that fail. The limit keeps such messages from filling the log.
    """

    def __init__(self) -> None:
        self._failures, self._dead_letters = LogLimit(LOG_PERIOD_S), LogLimit(LOG_PERIOD_S)

    def step_failed(self, name: str, what: str, *, is_of_message: bool) -> None:
        """Log the current exception as the failure of a step.

        Args:
            name: Name of the actor.
            what: Description of the step, such as "handling Keyframe".
            is_of_message: Whether the step handled a message. At most one such failure per minute
                is logged.
        """
        if not is_of_message or self._failures.is_due():
            log.exception("%s: %s failed; restoring the actor.", name, what)

    def dead_lettered(self, name: str, message: Message, count: int) -> None:
        """Log that a message is discarded, because the actor twice failed to handle it.

        Args:
            name: Name of the actor.
            message: The discarded message.
            count: Number of messages discarded so far.
        """
        if self._dead_letters.is_due():
            log.error(
                "%s: message %s (stamp %d ns) failed twice and is discarded as a dead letter (%d "
                "so far). The traceback is above; please report it with the recording.",
                name, type(message).__name__, message.stamp_ns, count,
            )  # fmt: skip
