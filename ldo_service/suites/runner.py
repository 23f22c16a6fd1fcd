"""Execution of the runs of a suite, each in its own process.

Finished runs are not repeated, so an interrupted suite resumes where it stopped. A failed run is
marked as failed in the table and does not stop the other runs.
"""

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from ldo_service.batch import BatchJob, LocalExecutor, Recording, ResultFolder
from ldo_service.batch.job import RunPlan, key_of
from ldo_service.batch.results import EVALUATION
from ldo_service.batch.sources import measure
from ldo_service.config import checked, load_config
from ldo_service.errors import ConfigError, LdoError

from .suite import SYNTHETIC, EvaluatedRun, Suite, SuiteRun

log = logging.getLogger(__name__)

NO_DATA = "no data"
STAGING = ".staging"  # Folder of unfinished runs, in the folder of the suite.


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a run.

    Attributes:
        entry: The run.
        evaluated: Results of the run; None if the run has no results.
        missing: Text that the table shows in place of results, such as "no data".
    """

    entry: SuiteRun
    evaluated: EvaluatedRun | None
    missing: str = ""


@dataclass(frozen=True, slots=True)
class SuiteRunner:
    """Runner of a suite.

    Attributes:
        suite: The suite.
        data: Folder with the data sets.
        out: Folder for the results of the runs.
        settings: Settings of all runs; a variant can override them.
        overwrite: True to repeat finished runs too.
        workers: Number of runs at the same time. A single worker uses all cores; several workers
            use one core each.
        lpips: Network that computes LPIPS; None to omit LPIPS.
    """

    suite: Suite
    data: Path
    out: Path
    settings: tuple[str, ...] = ()
    overwrite: bool = False
    workers: int = 1
    lpips: Path | None = None

    def entries(self) -> list[SuiteRun]:
        """Return all runs of the suite."""
        return list(self.suite.entries(self.data))

    def outcomes(self, begun: Callable[[SuiteRun], None]) -> Iterator[Outcome]:
        """Run the suite and yield the outcome of each run, in the order of `entries`.

        Args:
            begun: Function that is called with each run before the run starts.

        Raises:
            ConfigError: A setting of a variant or an option of the suite is invalid.
        """
        for settings in self.suite.variants.values():
            self._plan(settings)
        entries = self.entries()
        sources = self._sources(entries)
        failures = dict[str, str]()
        # A run that reuses a front end starts after all runs that record one.
        for is_second in (False, True):
            wave = [entry for entry in entries if (entry.front_end is not None) == is_second]
            jobs = self._jobs(wave, sources, begun)
            with closing(LocalExecutor(self.workers).outcomes(jobs)) as outcomes:
                failures |= {o.folder: o.error for o in outcomes if not o.has_results}
        for entry in entries:
            yield self._outcome(entry, sources[entry.source], failures.get(str(entry.folder), ""))

    def _sources(self, entries: list[SuiteRun]) -> dict[str, Recording | str]:
        """Return the recording of each source, or the reason why it cannot be used."""
        return {entry.source: _recording(entry.source) for entry in entries}

    def _jobs(
        self,
        entries: list[SuiteRun],
        sources: dict[str, Recording | str],
        begun: Callable[[SuiteRun], None],
    ) -> Iterator[BatchJob]:
        """Yield the job of each run that has no results yet."""
        for entry in entries:
            begun(entry)
            recording = sources[entry.source]
            if isinstance(recording, Recording):
                job = self.job(entry, recording)
                if self.overwrite or ResultFolder.of(job).finished() is None:
                    yield job

    def job(self, entry: SuiteRun, recording: Recording) -> BatchJob:
        """Return the batch job that executes a run."""
        records = self.suite.front_end is not None and entry.front_end is None
        reused = entry.front_end_folder
        plan = self._plan(entry.settings)
        first = key_of(recording, self._plan(self.suite.front_end_settings())) if reused else ""
        return BatchJob(
            recording=recording,
            plan=plan,
            out=str(self.out.absolute()),
            folder=str(entry.folder),
            key=key_of(recording, plan, front_end=first, keeps_front_end=records),
            keeps_front_end=records,
            front_end=str(reused or ""),
            staging=str(self.out.absolute() / STAGING),
            repeats=self.overwrite,
        )

    def _plan(self, settings: tuple[str, ...] | None) -> RunPlan:
        suite = self.suite
        config = load_config(None, (*self.settings, *(settings or ())))
        tracker = replace(config.tracker, hold_out=suite.hold_out)
        return RunPlan(
            config=checked(replace(config, tracker=tracker)),
            stride=suite.stride,
            max_frames=suite.max_frames,
            refine=suite.refine,
            threads=0 if self.workers == 1 else 1,
            evaluates_all=True,
            lpips=str(self.lpips.absolute()) if self.lpips else "",
        )

    def _outcome(self, entry: SuiteRun, source: Recording | str, failure: str) -> Outcome:
        if source == NO_DATA:
            return Outcome(entry, None, NO_DATA)
        failure = source if isinstance(source, str) else failure
        try:
            if not failure:
                return Outcome(entry, read_evaluated_run(self.out / entry.folder))
        except ConfigError as error:
            failure = str(error)
        log.error(
            "suite: run %s failed: %s The table shows this run as failed.", entry.folder, failure
        )
        return Outcome(entry, None, "failed")


def _recording(source: str) -> Recording | str:
    """Return the recording of a source, or the reason why it cannot be used."""
    if not source.startswith(SYNTHETIC) and not Path(source).exists():
        return NO_DATA
    try:
        return measure(source)
    except LdoError as error:
        return str(error)


def read_evaluated_run(folder: Path) -> EvaluatedRun:
    """Return the results of a finished run.

    Raises:
        ConfigError: A file with results cannot be read.
    """
    try:
        texts = [(folder / name).read_text() for name in ("summary.json", EVALUATION)]
        return EvaluatedRun(*map(json.loads, texts))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{folder} has no valid results ({error}). Remove this folder, and start the suite "
            "again to repeat the run."
        ) from error
