"""An actor lives its recorded life again: the same messages, situations and restarts.

What it makes must have the digests of the recording. A step that failed leaves nothing behind, so
whether it fails again is counted and not judged.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import msgspec

from ldo_service.errors import DataError, ReplayDiverged
from ldo_service.runtime.actor import Actor, FlowStatus
from ldo_service.runtime.delivery_state import RestoredState, counts_by_topic, restore_actor
from ldo_service.runtime.journal import (
    Gap,
    Output,
    Started,
    StepRecord,
    checksum,
    digest_of,
    outputs_of,
)
from ldo_service.runtime.step import Produced, produce
from ldo_service.schemas import Message, decode
from ldo_service.storage.state_codec import decode_state

from .recording import JournalFile

Make = Callable[[Mapping[str, str]], Actor]  # from what a file says about itself


@dataclass
class ReplayReport:
    """What came of a replay; it ends at the first difference."""

    actor: str
    starts: int = 0
    restored: int = 0  # starts that took up a state
    steps: int = 0
    failures: int = 0
    failures_repeated: int = 0
    dead_lettered: int = 0
    taken: Counter[str] = field(default_factory=Counter)  # messages by topic
    made: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    is_complete: bool = True  # False: something was not recorded
    difference: ReplayDiverged | None = None

    def verify(self) -> None:
        """Raises ReplayDiverged, or DataError when the recording has a gap."""
        if self.difference is not None:
            raise self.difference
        if not self.is_complete:
            raise DataError(
                f"{self.actor}: its {self.steps} steps replay, and more cannot be said: "
                + " ".join(self.notes)
            )


def replay(
    actor: str,
    files: Iterable[JournalFile],
    make: Make,
    advance: Callable[[], None] = lambda: None,
) -> ReplayReport:
    """Replay every life of an actor; `advance` is called after each step."""
    replayed = ReplayReport(actor)
    try:
        for file in files:
            for _ in ReplaySession(file, make, replayed).steps():
                advance()
    except ReplayDiverged as difference:
        replayed.difference = difference
    return replayed


class ReplaySession:
    """One file, step by step."""

    def __init__(self, file: JournalFile, make: Make, replayed: ReplayReport) -> None:
        self._file, self._make, self._replayed = file, make, replayed
        self._actor: Actor | None = None  # None: nothing is known until the next start
        self._last: StepRecord | None = None

    def steps(self) -> Iterator[StepRecord]:
        for entry in self._file.entries():
            match entry:
                case Started():
                    self._start(entry)
                case Gap():
                    self._skip(entry)
                case StepRecord() if self._actor is not None:
                    self._replayed.steps += 1
                    self._step(self._actor, entry)
                    self._last = entry
                    yield entry
        if not self._file.is_whole:
            self._note(f"was cut off{self._under_way()}; it is replayed up to there.")

    def _under_way(self) -> str:
        """What was taken last and not finished: perhaps what killed it."""
        taken = self._file.messages
        if not taken or (self._last and self._last.taken == taken[-1].number):
            return ""
        return f" while it handled {taken[-1].topic} of stamp {taken[-1].stamp_ns}"

    def _start(self, start: Started) -> None:
        self._replayed.starts += 1
        if start.state is None:
            self._actor = self._make(self._file.about)
        else:
            self._replayed.restored += 1
            self._actor = self._successor(start, start.state)

    def _successor(self, start: Started, state: Mapping[str, bytes]) -> Actor:
        try:
            past = RestoredState.of({part: decode_state(body) for part, body in state.items()})
            about = self._file.about
            return restore_actor(self._make(about), past, lambda: self._make(about))
        except Exception as error:
            where = f"the start before step {start.step} ({self._file.path.name})"
            what = "the state it began from"
            raise ReplayDiverged(
                self._replayed.actor, where, what, "taken up", f"refused, {error!r},"
            ) from error

    def _skip(self, gap: Gap) -> None:
        self._actor = None
        if gap.reason == "limit":
            self._note(f"ends at its size limit, before step {gap.step}.")
            return
        self._replayed.is_complete = False
        why = "a state could not be recorded"
        if gap.reason == "slow":
            why = f"the disk was too slow and {gap.lost} messages were not recorded"
        self._note(f"has a gap before step {gap.step}: {why}; the replay stops there.")

    def _note(self, text: str) -> None:
        self._replayed.notes.append(f"{self._file.path.name} {text}")

    # --- one step ---------------------------------------------------------------------------------
    def _step(self, actor: Actor, step: StepRecord) -> None:
        if actor.talks_outside:
            return
        actor.situation = FlowStatus(
            credits=counts_by_topic(step.credits, (out.topic for out in actor.outputs)),
            backlog=counts_by_topic(step.backlog, (port.topic for port in actor.inputs)),
        )
        match step.kind:
            case "done":
                message = self._message(actor, step)
                self._compare(step, self._produce(step, actor, actor.handle(message)))
                actor.snapshot()  # as the stage does: it may keep what it gave away
                actor.on_saved()
            case "failed":
                self._fail(step, actor, self._message(actor, step))
            case "dead_lettered":
                self._replayed.dead_lettered += 1
            case "resumed":
                self._compare(step, self._produce(step, actor, actor.on_restored()))
                actor.checkpoint()
                actor.on_saved()
            case "finished":
                self._compare(step, self._produce(step, actor, actor.on_stop()))

    def _message(self, actor: Actor, step: StepRecord) -> Message:
        self._replayed.taken[step.topic] += 1
        body = self._file.taken(step)
        if checksum(body) != step.checksum:
            what = f"the checksum of {step.topic}, which it took,"
            raise self._diverged(step, what, step.checksum, checksum(body))
        kinds = {port.topic.name: port.topic.message for port in actor.inputs}
        kind = kinds.get(step.topic)
        if kind is None:
            raise self._diverged(step, step.topic, "an input", "none")
        try:
            return decode(body, kind)
        except msgspec.DecodeError as error:
            raise self._diverged(step, step.topic, "readable", f"not: {error}") from error

    def _produce(
        self, step: StepRecord, actor: Actor, messages: Iterable[Message]
    ) -> list[Produced]:
        try:
            return produce(actor, messages)
        except Exception as error:
            raise self._diverged(step, "the step", "done", f"a failure, {error!r},") from error

    def _fail(self, step: StepRecord, actor: Actor, message: Message) -> None:
        self._actor = None  # a start follows
        self._replayed.failures += 1
        try:
            produce(actor, actor.handle(message))
        except Exception:
            self._replayed.failures_repeated += 1
        else:
            self._note(f"step {step.step} failed when recorded ({step.error}) and does not now.")

    def _compare(self, step: StepRecord, produced: list[Produced]) -> None:
        self._replayed.made.update(made.topic.name for made in produced)
        outputs = outputs_of(produced)
        if outputs != step.outputs:
            what = f"the digest of what it made ({first_difference(step.outputs, outputs)})"
            raise self._diverged(step, what, step.digest, digest_of(outputs))

    def _diverged(
        self, step: StepRecord, what: str, recorded: str, replayed: str
    ) -> ReplayDiverged:
        cause = f", {step.topic} #{step.seq}" if step.topic else ""
        where = f"step {step.step} ({self._file.path.name}{cause})"
        return ReplayDiverged(self._replayed.actor, where, what, recorded, replayed)


def first_difference(recorded: tuple[Output, ...], replayed: tuple[Output, ...]) -> str:
    """In words."""
    for place, (old, new) in enumerate(zip(recorded, replayed, strict=False), 1):
        if old != new:
            topics = old.topic if old.topic == new.topic else f"{old.topic}, now {new.topic}"
            return f"output {place} of {len(recorded)} differs: {topics}"
    return f"{len(recorded)} outputs, now {len(replayed)}"
