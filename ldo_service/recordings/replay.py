"""Replay of a recorded actor with the recorded inputs, flow status (`FlowStatus`) and restarts.

The replayed outputs must have the same digests as the recorded outputs. A step that failed in the
recording had no effect on the actor's state. The replay therefore continues even if such a step now
succeeds. The report counts the steps that fail again.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

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

from .actor_files import FileArchive
from .recording import JournalFile

Make = Callable[[Mapping[str, str]], Actor]  # Creates an actor from the metadata of a file.


@dataclass
class ReplayReport:
    """Result of a replay, which ends at the first difference from the recording."""

    actor: str
    starts: int = 0  # Number of starts of the actor, with or without a saved state.
    restored: int = 0  # Number of starts with a saved state.
    steps: int = 0  # Number of replayed steps.
    failures: int = 0  # Steps that failed when they were recorded.
    failures_repeated: int = 0  # Steps that failed when recorded, and again in the replay.
    dead_lettered: int = 0  # Messages that became dead letters.
    taken: Counter[str] = field(default_factory=Counter)  # Number of replayed inputs, by topic.
    made: Counter[str] = field(default_factory=Counter)  # Number of replayed outputs, by topic.
    notes: list[str] = field(default_factory=list)  # Sentences for the user.
    # False if the recording has a gap. Its end at the size limit does not count as a gap.
    is_complete: bool = True
    difference: ReplayDiverged | None = None  # First difference; None if there is none.

    def verify(self) -> None:
        """Check that all steps were replayed without a difference.

        Raises:
            ReplayDiverged: A step differs.
            DataError: The recording has a gap.
        """
        if self.difference is not None:
            raise self.difference
        if not self.is_complete:
            raise DataError(
                f"{self.actor}: {self.steps} recorded steps verified, but the recording is "
                f"incomplete: {' '.join(self.notes)} To verify all steps, make a new recording."
            )


def replay(
    actor: str,
    files: Iterable[JournalFile],
    make: Make,
    advance: Callable[[], None] = lambda: None,
    folder: Path | None = None,
) -> ReplayReport:
    """Replay all recorded processes of an actor.

    Args:
        actor: Name of the actor.
        files: Recorded journals, one for each process of the actor, in the order of the processes.
        make: Function that creates a new actor from the metadata of a journal.
        advance: Function that is called after each step.
        folder: Temporary folder for the files to which the actor's state refers; None if there are
            none. At each recorded start, the recorded files replace the content of the folder.

    Returns:
        The counters and the first difference, if there is one.

    Raises:
        DataError: A file of the recording is missing or damaged.
    """
    replayed = ReplayReport(actor)
    try:
        for file in files:
            for _ in ReplaySession(file, make, replayed, folder).steps():
                advance()
    except ReplayDiverged as difference:
        replayed.difference = difference
    return replayed


class ReplaySession:
    """Replay of one recorded journal, step by step."""

    def __init__(
        self,
        file: JournalFile,
        make: Make,
        replayed: ReplayReport,
        folder: Path | None = None,
    ) -> None:
        self._file, self._make, self._replayed, self._folder = file, make, replayed, folder
        # The actor is None until the next recorded start; steps are skipped meanwhile.
        self._actor: Actor | None = None
        self._last: StepRecord | None = None  # Last replayed step.

    def steps(self) -> Iterator[StepRecord]:
        """Replay the steps one by one and yield the record of each.

        Raises:
            ReplayDiverged: A step differs.
            DataError: The file is damaged.
        """
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
            self._note(f"was cut off{self._under_way()}; it is replayed up to that point.")

    def _under_way(self) -> str:
        """Describe the last input if its step was not recorded; else return an empty string.

        A step that was not recorded may have killed the process.
        """
        taken = self._file.messages
        if not taken or (self._last and self._last.taken == taken[-1].number):
            return ""
        return f" while the actor handled {taken[-1].topic} (stamp {taken[-1].stamp_ns} ns)"

    def _start(self, start: Started) -> None:
        self._replayed.starts += 1
        if start.state is None:
            self._actor = self._make(self._file.about)
        else:
            self._replayed.restored += 1
            self._restore_files(start)
            self._actor = self._restored_actor(start, start.state)

    def _restore_files(self, start: Started) -> None:
        """Replace the files of the actor by those of a recorded start."""
        if self._folder is None:
            return
        if start.files is not None:
            FileArchive(self._file.path).restore(start.files, self._folder)
        elif self._replayed.starts == 1:
            self._note(
                "starts from a saved map, but an earlier version recorded it without the keyframe "
                "images, so the replay may diverge. Make a new recording."
            )

    def _restored_actor(self, start: Started, state: Mapping[str, bytes]) -> Actor:
        try:
            past = RestoredState.of({part: decode_state(body) for part, body in state.items()})
            about = self._file.about
            return restore_actor(self._make(about), past, lambda: self._make(about))
        except Exception as error:
            where = f"the start before step {start.step} ({self._file.path.name})"
            what = "the saved state"
            raise ReplayDiverged(
                self._replayed.actor, where, what, "restored", f"rejected ({error!r})"
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
        self._note(
            f"has a gap before step {gap.step}: {why}. The replay continues at the next start of "
            "the actor."
        )

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
                actor.snapshot()  # The stage takes one too; it may change caches.
                actor.on_saved()
            case "failed":
                self._fail(step, actor, actor.handle(self._message(actor, step)))
            case "dead_lettered":
                self._replayed.dead_lettered += 1
            case "resumed":
                self._compare(step, self._produce(step, actor, actor.on_restored()))
                actor.checkpoint()
                actor.on_saved()
            case "idle":
                self._compare(step, self._produce(step, actor, actor.on_idle()))
                actor.snapshot()
                actor.on_saved()
            case "idle_failed":
                self._fail(step, actor, actor.on_idle())
            case "finished":
                self._compare(step, self._produce(step, actor, actor.on_stop()))

    def _message(self, actor: Actor, step: StepRecord) -> Message:
        self._replayed.taken[step.topic] += 1
        body = self._file.taken(step)
        if checksum(body) != step.checksum:
            what = f"the checksum of its input {step.topic}"
            raise self._diverged(step, what, step.checksum, checksum(body))
        kinds = {port.topic.name: port.topic.message for port in actor.inputs}
        kind = kinds.get(step.topic)
        if kind is None:
            raise self._diverged(step, step.topic, recorded="an input", replayed="none")
        try:
            return decode(body, kind)
        except msgspec.DecodeError as error:
            raise self._diverged(step, step.topic, "decoded", f"malformed ({error})") from error

    def _produce(
        self, step: StepRecord, actor: Actor, messages: Iterable[Message]
    ) -> list[Produced]:
        try:
            return produce(actor, messages)
        except Exception as error:
            raise self._diverged(step, "the step", "done", f"a failure ({error!r})") from error

    def _fail(self, step: StepRecord, actor: Actor, messages: Iterable[Message]) -> None:
        self._actor = None  # The next entry is a start.
        self._replayed.failures += 1
        try:
            produce(actor, messages)
        except Exception:
            self._replayed.failures_repeated += 1
        else:
            self._note(f"has step {step.step}, which failed ({step.error}) but succeeds now.")

    def _compare(self, step: StepRecord, produced: list[Produced]) -> None:
        self._replayed.made.update(made.topic.name for made in produced)
        outputs = outputs_of(produced)
        if outputs != step.outputs:
            what = f"the digest of its outputs ({first_difference(step.outputs, outputs)})"
            raise self._diverged(step, what, step.digest, digest_of(outputs))

    def _diverged(
        self, step: StepRecord, what: str, recorded: str, replayed: str
    ) -> ReplayDiverged:
        cause = f", {step.topic} #{step.seq}" if step.topic else ""
        where = f"step {step.step} ({self._file.path.name}{cause})"
        return ReplayDiverged(self._replayed.actor, where, what, recorded, replayed)


def first_difference(recorded: tuple[Output, ...], replayed: tuple[Output, ...]) -> str:
    """Describe the first difference between recorded and replayed outputs."""
    for place, (old, new) in enumerate(zip(recorded, replayed, strict=False), 1):
        if old != new:
            topics = old.topic if old.topic == new.topic else f"{old.topic}, now {new.topic}"
            return f"output {place} of {len(recorded)} differs: {topics}"
    return f"{len(recorded)} outputs, now {len(replayed)}"
