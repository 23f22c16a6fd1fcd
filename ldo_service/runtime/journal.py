"""Journal of an actor: the input, the flow status and the result of each step.

| channel         | entry        | meaning                                                         |
|-----------------|--------------|-----------------------------------------------------------------|
| `journal/start` | `Started`    | An actor is ready: new, or restored from a saved state.         |
| `journal/step`  | `StepRecord` | The actor handled the last input under the given flow status.   |
| `journal/gap`   | `Gap`        | Entries are missing from here on.                               |

Inputs are recorded between these entries, each on the channel of its topic, with its encoded bytes.
Steps are numbered from 0 in each file. The flow status is the credit of the actor's outputs and the
backlog of its inputs (`FlowStatus`). The outputs of an actor depend only on its state at the start,
its inputs and the flow status. `ldo_service.recordings.replay` can therefore repeat and
verify every step.
"""

import asyncio
import hashlib
import logging
import zlib
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from typing import Literal, TypeAlias

import msgspec

from ldo_service.storage.state_store import State

from .actor import FlowStatus
from .inlet import Delivery
from .step import Produced

log = logging.getLogger(__name__)

JOURNAL_WITHIN_S = 5.0  # Maximum time to wait at the end for the journal to be written.

Kind: TypeAlias = Literal[
    "done",
    "failed",  # The handler raised: its outputs are dropped and the actor is restored.
    "dead_lettered",  # The message failed twice.
    "resumed",  # Restored messages were published; the step has no input.
    "idle",  # The actor worked while no message arrived; the step has no input.
    "idle_failed",  # The idle work raised: the actor is restored.
    "finished",  # Final messages were published; the step has no input.
]

WITHOUT_INPUT: frozenset[Kind] = frozenset(("resumed", "idle", "idle_failed", "finished"))


class Output(msgspec.Struct, frozen=True, array_like=True):
    """Digest of one output of a step."""

    topic: str  # Name of the topic.
    digest: str  # Digest of the encoded message; see `journal.digest`.


class Started(msgspec.Struct, frozen=True, kw_only=True):
    """Journal entry for the start of a new or restored actor."""

    step: int  # Number of the next step.
    state: dict[str, bytes] | None  # Parts as `state_codec` encodes them; None: a new actor.
    # CRC-32 of each file that the state refers to, by its path in the actor's folder. None if the
    # actor has no such files.
    files: dict[str, str] | None = None


class StepRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Journal entry for one step: its input, flow status and outputs."""

    step: int  # Number of the step.
    kind: Kind  # Outcome of the step.
    taken: int  # Number of the input in this file; -1: no input.
    topic: str = ""  # Topic of the input.
    source: str = ""  # Header fields of the input: `source`, `epoch` and `seq`.
    epoch: int = 0
    seq: int = 0
    checksum: str = ""  # CRC-32 of the encoded input; see `journal.checksum`.
    credits: dict[str, int] = {}  # Messages that could be sent without waiting, by topic.
    outputs: tuple[Output, ...] = ()  # Outputs in order.
    digest: str = ""  # Digest of all outputs in order; see `digest_of`.
    error: str = ""  # Exception of a failed step.
    backlog: dict[str, int] = {}  # Messages queued behind the input, by topic.


class Gap(msgspec.Struct, frozen=True, kw_only=True):
    """Journal entry that replaces all missing entries of a gap in the journal."""

    step: int  # Number of the first missing step.
    # The disk was too slow (slow), the recording reached its maximum size (limit), or a saved state
    # could not be recorded (state).
    reason: Literal["slow", "limit", "state"]
    lost: int = 0  # Inputs that were not recorded; 0: unknown.


Entry: TypeAlias = Started | StepRecord | Gap
CHANNELS: Mapping[type[Entry], str] = {
    Started: "journal/start",
    StepRecord: "journal/step",
    Gap: "journal/gap",
}


def digest(*bodies: bytes | memoryview) -> str:
    """Compute one BLAKE2b digest (16 bytes, hexadecimal) of message bodies, in order."""
    state = hashlib.blake2b(digest_size=16)
    for body in bodies:
        state.update(len(body).to_bytes(8, "little"))
        state.update(body)
    return state.hexdigest()


def checksum(body: bytes | memoryview) -> str:
    """Compute the CRC-32 in hexadecimal.

    It detects damaged bytes in a fifth of the time that `digest` takes.
    """
    return f"{zlib.crc32(body):08x}"


def outputs_of(produced: Iterable[Produced]) -> tuple[Output, ...]:
    """Return the digest of each produced message."""
    return tuple(Output(made.topic.name, digest(made.body)) for made in produced)


def digest_of(outputs: Iterable[Output]) -> str:
    """Compute one digest for all outputs of a step."""
    return digest(*(f"{output.topic} {output.digest}".encode() for output in outputs))


class Journal:
    """Receiver of journal entries. This class discards them; `Recorder` writes them to a file."""

    def record_files(self) -> None:
        """Record the files that a saved state refers to; called before each start of the actor."""

    def record_start(self, state: State | None) -> None:
        """Record the start of an actor; `state` is its saved state, or None if it has none."""

    def record_input(self, delivery: Delivery, stamp_ns: int) -> None:
        """Record the input of the next step, and the stamp of its message in ns.

        If the step fails, the stage repeats it with the same input and does not call this
        method again.
        """

    def record_step(
        self,
        kind: Kind,
        situation: FlowStatus,
        produced: Iterable[Produced] = (),
        error: str = "",
    ) -> None:
        """Record a finished step; the stage calls this method before it sends the outputs.

        Args:
            kind: Outcome of the step.
            situation: Credits and backlogs before the step.
            produced: Outputs of the step.
            error: Exception of a failed step; empty on success.
        """

    def close(self) -> "Future[None]":
        """Stop recording; the returned future is done when all recorded entries are written."""
        future: Future[None] = Future()
        future.set_result(None)
        return future

    def metrics(self) -> dict[str, float]:
        """Return the journal's metrics for the health message, by name."""
        return {}


async def close_journal(journal: Journal, actor: str) -> None:
    """Close a journal, and wait at most `JOURNAL_WITHIN_S` seconds until it is written."""
    written = asyncio.wrap_future(journal.close())
    done, _ = await asyncio.wait({written}, timeout=JOURNAL_WITHIN_S)
    if not done:
        written.cancel()
        log.error(
            "%s: the last entries of its recording were not written in time; a replay ends before "
            "them.",
            actor,
        )
