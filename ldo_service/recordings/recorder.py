"""Journal of an actor, written by a separate thread so that no step waits for the disk."""

import logging
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from msgspec.structs import replace

from ldo_service.runtime.actor import FlowStatus
from ldo_service.runtime.inlet import Delivery
from ldo_service.runtime.journal import (
    WITHOUT_INPUT,
    Gap,
    Journal,
    Kind,
    Started,
    StepRecord,
    checksum,
    digest_of,
    outputs_of,
)
from ldo_service.runtime.step import Produced
from ldo_service.schemas.topics import Topic
from ldo_service.storage.state_codec import encode_state
from ldo_service.storage.state_store import State
from ldo_service.transport.worker import Worker

from .actor_files import ActorFiles, FileArchive
from .mcap_file import RecordConfig, RecordingFile

log = logging.getLogger(__name__)

ENTRY_BYTES = 1000  # Estimated memory of a queued entry in addition to its body.


@dataclass(frozen=True, slots=True)
class Taken:
    """Recorded input of the next step; a failed step is repeated with the same input."""

    number: int  # Sequence number of the input in the MCAP file.
    stamp_ns: int  # Stamp of the message.
    delivery: Delivery


class Recorder(Journal):
    """Journal of one actor that is written to a file.

    The queue to the writing thread is limited to `queue_mb`. While the queue is full, inputs and
    their steps are not recorded. Each such gap is recorded and logged; the actor is not affected.
    """

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str],
        config: RecordConfig,
        files: ActorFiles | None = None,
    ) -> None:
        """Create the file.

        Args:
            path: The new file.
            about: Fields of the file's metadata record.
            config: Limits of the recording.
            files: Files to which the saved state of the actor refers; None if there are none.

        Raises:
            OSError: The file exists or cannot be written.
        """
        self._file = RecordingFile(path, about, config)
        self._archive, self._config = FileArchive(path), config
        self._files = files
        # Checksum of each file of the next start by path; None if the actor has no files.
        self._checksums: dict[str, str] | None = None
        self._has_all_files = True  # False if a file of the next start is not recorded.
        self._max_waiting = int(config.queue_mb * 1e6)
        self._writer = Worker(f"journal {path.stem}")
        self._lock = Lock()  # Guards `_waiting`.
        self._waiting = 0  # Bytes in the queue to the writer.
        self._steps = self._numbers = 0
        self._taken: Taken | None = None  # The last input; None if it was not recorded.
        self._lost = 0  # Messages dropped in the current gap.
        self._lost_before = 0  # Messages dropped in earlier gaps.
        self._closed: Future[None] | None = None

    # --- called by the stage ----------------------------------------------------------------------
    def record_files(self) -> None:
        """Record the files of the actor, which a replay needs to start from a saved state."""
        if self._files is None or not self._file.is_open:
            return
        try:
            self._checksums = self._archive.add(self._files, self._config)
            self._has_all_files = True
        except OSError as error:
            self._has_all_files = False
            log.error(
                "%s: the files of the actor in %s cannot be recorded: %s. A replay stops here; the "
                "robot continues. Record to a disk with more space, or raise recording.max_gb.",
                *(self._file.path, self._files.folder),
                ": ".join(str(part) for part in (error.filename, error.strerror) if part),
            )

    def record_start(self, state: State | None) -> None:
        """Record the start of an actor with its restored state.

        If the state or a file cannot be recorded, a gap is recorded instead.

        Args:
            state: The restored state; None if the actor starts without a state.
        """
        try:
            parts = None if state is None else {k: encode_state(v) for k, v in state.items()}
        except (NotImplementedError, TypeError) as error:
            log.error("%s: the actor's state cannot be recorded: %s. A replay stops here.",
                      self._file.path, error)  # fmt: skip
            self._submit(0, self._file.add_entry, Gap(step=self._steps, reason="state"))
            return
        if parts is not None and not self._has_all_files:
            self._submit(0, self._file.add_entry, Gap(step=self._steps, reason="state"))
            return
        size = sum(map(len, (parts or {}).values()))
        checksums = None if parts is None else self._checksums
        start = Started(step=self._steps, state=parts, files=checksums)
        self._submit(size, self._file.add_entry, start)

    def record_input(self, delivery: Delivery, stamp_ns: int) -> None:
        """Record the input of the next step, or drop it if the queue is full."""
        size = len(delivery.body)
        with self._lock:
            has_place = self._waiting + size <= self._max_waiting
        if not has_place:
            self._lose(delivery)
            return
        self._mark_gap()
        self._taken = Taken(self._numbers, stamp_ns, delivery)
        self._numbers += 1
        self._submit(size, self._write_message, self._taken)

    def record_step(
        self,
        kind: Kind,
        situation: FlowStatus,
        produced: Iterable[Produced] = (),
        error: str = "",
    ) -> None:
        """Record a finished step, unless the recorder had to drop its input (slow or full disk).

        Args:
            kind: Outcome of the step.
            situation: Credits and backlog that the actor had during the step.
            produced: Outputs of the step.
            error: Error of a failed step; "" if it succeeded.
        """
        takes_none = kind in WITHOUT_INPUT
        taken = None if takes_none else self._taken
        if taken is None and (not takes_none or self._lost):
            return  # The input was not recorded.
        made = tuple(produced)
        step = StepRecord(
            step=self._steps,
            kind=kind,
            taken=-1 if taken is None else taken.number,
            credits=_by_name(situation.credits),
            backlog=_by_name(situation.backlog),
            error=error,
        )
        self._steps += 1
        self._submit(sum(len(out.body) for out in made), self._write_step, step, taken, made)

    def close(self) -> "Future[None]":
        """Stop recording, and return a future that is done when the file is closed."""
        if self._closed is None:
            self._mark_gap()
            self._closed = self._writer.submit(self._file.close)
            self._writer.close()
        return self._closed

    def metrics(self) -> dict[str, float]:
        """Return the metrics of the recording, by name."""
        return {
            "journal_is_open": float(self._file.is_open),
            "journal_steps": self._steps,
            "journal_messages_dropped": self._lost_before + self._lost,
            "journal_waiting_mb": self._waiting / 1e6,
            **self._file.metrics(),
        }

    # --- gaps -------------------------------------------------------------------------------------
    def _lose(self, delivery: Delivery) -> None:
        if self._lost == 0:
            log.error(
                "%s: the disk is too slow: %.0f MB wait to be written. The message of %s with "
                "number %d and later messages are not recorded. A replay stops here; the robot "
                "continues. Record to a faster disk, or lower the frame rate.",
                *(self._file.path, self._waiting / 1e6),
                *(delivery.port.topic.name, delivery.header.seq),
            )
        self._lost += 1
        self._taken = None

    def _mark_gap(self) -> None:
        if self._lost:
            gap = Gap(step=self._steps, reason="slow", lost=self._lost)
            self._submit(0, self._file.add_entry, gap)
            log.error("%s: %d messages were not recorded; a replay stops before them.",
                      self._file.path, self._lost)  # fmt: skip
            self._lost, self._lost_before = 0, self._lost_before + self._lost

    # --- in the writer's thread -------------------------------------------------------------------
    def _submit(self, size: int, job: Callable[..., None], *args: object) -> None:
        size += ENTRY_BYTES
        with self._lock:
            self._waiting += size
        self._writer.submit(self._run, size, job, *args)

    def _run(self, size: int, job: Callable[..., None], *args: object) -> None:
        try:
            job(*args)
        except Exception:
            log.exception("%s: writing failed. This recording ends here; the robot continues.",
                          self._file.path)  # fmt: skip
            self._file.abandon()
        finally:
            with self._lock:
                self._waiting -= size

    def _write_message(self, taken: Taken) -> None:
        topic, body = taken.delivery.port.topic, taken.delivery.body
        self._file.add(topic.name, topic.message, body, taken.number, taken.stamp_ns)

    def _write_step(
        self, step: StepRecord, taken: Taken | None, produced: tuple[Produced, ...]
    ) -> None:
        if not self._file.is_open:
            return
        outputs = outputs_of(produced)
        step = replace(step, outputs=outputs, digest=digest_of(outputs))
        if taken is not None:
            header = taken.delivery.header
            step = replace(
                step,
                topic=taken.delivery.port.topic.name,
                source=header.source,
                epoch=header.epoch,
                seq=header.seq,
                checksum=checksum(taken.delivery.body),
            )
        self._file.add_entry(step)
        if self._file.is_over_limit():
            self._end_at_limit(step.step + 1)

    def _end_at_limit(self, step: int) -> None:
        self._file.add_entry(Gap(step=step, reason="limit"))
        self._file.close()
        log.error(
            "%s: the folder of the recording has reached recording.max_gb, or less than "
            "recording.min_free_gb is free on the disk. This recording ends here; the robot "
            "continues.",
            self._file.path,
        )


def _by_name(counts: Mapping[Topic, int]) -> dict[str, int]:
    return {topic.name: count for topic, count in counts.items()}
