"""What determined every step of an actor, and what came of it.

    journal/start   Started   an actor is in place: new, or restored from its predecessor's state
    journal/step    Step      it handled the message taken last, in the situation it saw
    journal/gap     Gap       from here on something is missing

The messages taken lie between these, each on the channel of its topic, as they were decoded. Steps
count from 0 in each file. What is not here cannot change what an actor makes: see `replay`.
"""

import hashlib
import zlib
from collections.abc import Iterable, Mapping
from concurrent.futures import Future
from typing import Literal, TypeAlias

import msgspec

from ldo_service.storage.state_store import State

from .actor import FlowStatus
from .inlet import Delivery
from .step import Produced

Kind: TypeAlias = Literal[
    "done",
    "failed",  # the handler raised: its outputs are dropped, and a successor started
    "dead_lettered",  # after failing twice
    "resumed",  # first words of a successor: no message was taken
    "finished",  # last words: none either
]


class Output(msgspec.Struct, frozen=True, array_like=True):
    topic: str
    digest: str


class Started(msgspec.Struct, frozen=True, kw_only=True):
    step: int  # the one that follows
    state: dict[str, bytes] | None  # parts as `state_store` encodes them; None: begins anew


class StepRecord(msgspec.Struct, frozen=True, kw_only=True):
    step: int
    kind: Kind
    taken: int  # number of the message in this file; -1: none
    topic: str = ""
    source: str = ""  # header of the message
    epoch: int = 0
    seq: int = 0
    checksum: str = ""  # of the message
    credits: dict[str, int] = {}  # by topic: what the actor could send without waiting
    outputs: tuple[Output, ...] = ()
    digest: str = ""  # of all outputs in order
    error: str = ""  # of a step that failed
    backlog: dict[str, int] = {}  # by topic: what waited behind the message


class Gap(msgspec.Struct, frozen=True, kw_only=True):
    step: int  # the one that would follow
    reason: Literal["slow", "limit", "state"]  # disk too slow; size limit; state unwritable
    lost: int = 0  # messages taken and not recorded; 0: unknown


Entry: TypeAlias = Started | StepRecord | Gap
CHANNELS: Mapping[type[Entry], str] = {
    Started: "journal/start",
    StepRecord: "journal/step",
    Gap: "journal/gap",
}


def digest(*bodies: bytes | memoryview) -> str:
    """BLAKE2b of 16 bytes, in hexadecimal, of bodies in order."""
    state = hashlib.blake2b(digest_size=16)
    for body in bodies:
        state.update(len(body).to_bytes(8, "little"))
        state.update(body)
    return state.hexdigest()


def checksum(body: bytes | memoryview) -> str:
    """CRC-32 in hexadecimal: tells damage at a fifth of the digest's cost."""
    return f"{zlib.crc32(body):08x}"


def outputs_of(produced: Iterable[Produced]) -> tuple[Output, ...]:
    return tuple(Output(made.topic.name, digest(made.body)) for made in produced)


def digest_of(outputs: Iterable[Output]) -> str:
    """One digest for all outputs of a step."""
    return digest(*(f"{output.topic} {output.digest}".encode() for output in outputs))


class Journal:
    """What a stage tells about itself, in order. This one listens to nothing; `Recorder` writes."""

    def record_start(self, state: State | None) -> None:
        """An actor is in place."""

    def record_input(self, delivery: Delivery, stamp_ns: int) -> None:
        """The message that the next steps speak of; the stamp is the message's own."""

    def record_step(
        self,
        kind: Kind,
        situation: FlowStatus,
        produced: Iterable[Produced] = (),
        error: str = "",
    ) -> None:
        """A step is over, and nothing of it was sent yet."""

    def close(self) -> "Future[None]":
        """Take nothing more; the future is done when all that was told is kept."""
        future: Future[None] = Future()
        future.set_result(None)
        return future

    def metrics(self) -> dict[str, float]:
        return {}
