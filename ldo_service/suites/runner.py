"""Execution of the runs of a suite, one after the other, each in its own process.

Finished runs are not repeated, so an interrupted suite resumes where it stopped. A failed run is
marked as failed in the table and does not stop the other runs.
"""

import json
import logging
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from ldo_service import versions
from ldo_service.errors import ConfigError
from ldo_service.runs.front_end import FRONT_END

from .suite import SYNTHETIC, EvaluatedRun, Suite, SuiteRun

log = logging.getLogger(__name__)

LDO = (sys.executable, "-m", "ldo_service")
ENTRY, RESULTS = "entry.json", "eval.json"


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a run.

    Attributes:
        entry: The run.
        evaluated: Results of the run; None if there are none.
        missing: Reason why there are no results, as printed in the table.
    """

    entry: SuiteRun
    evaluated: EvaluatedRun | None
    missing: str = ""


@dataclass(frozen=True, slots=True)
class SuiteRunner:
    """Runner of a suite.

    Attributes:
        suite: The suite.
        data: Folder with the sources.
        out: Folder for the runs.
        settings: Settings of all runs; the settings of a variant override these.
        overwrite: True to repeat finished runs too.
    """

    suite: Suite
    data: Path
    out: Path
    settings: tuple[str, ...] = ()
    overwrite: bool = False

    def entries(self) -> list[SuiteRun]:
        """Return all runs of the suite."""
        return list(self.suite.entries(self.data))

    def outcomes(self, begun: Callable[[SuiteRun], None]) -> Iterator[Outcome]:
        """Run the suite and yield the outcome of each run.

        Args:
            begun: Function that is called with each run before the run starts.
        """
        for entry in self.entries():
            begun(entry)
            yield self._outcome(entry)

    def _outcome(self, entry: SuiteRun) -> Outcome:
        if not entry.source.startswith(SYNTHETIC) and not Path(entry.source).exists():
            return Outcome(entry, None, "no data")
        folder = self.out / entry.folder
        if self.overwrite or not self._is_finished(entry, folder):
            failed = self._run(entry, folder)
            if failed:
                log.error(
                    "suite: run %s failed: %s The table shows this run as failed.",
                    entry.folder,
                    failed,
                )
                return Outcome(entry, None, "failed")
        try:
            return Outcome(entry, read_evaluated_run(folder))
        except ConfigError as error:
            log.error("suite: %s", error)
            return Outcome(entry, None, "failed")

    def _entry_json(self, entry: SuiteRun) -> str:
        """Return everything that the results of a run depend on, as JSON."""
        values = {
            **asdict(entry),
            "settings": (*self.settings, *entry.settings),
            "options": self.suite.options(),
            "ldo": versions()["ldo-slam"],
        }
        if self.suite.front_end is None:
            del values["front_end"]
        else:
            values["front_end_settings"] = self.suite.front_end_settings()
        return json.dumps(values, indent=1)

    def _is_finished(self, entry: SuiteRun, folder: Path) -> bool:
        entry_path = folder / ENTRY
        is_kept = entry.variant != self.suite.front_end or (folder / FRONT_END).is_file()
        return (
            is_kept and entry_path.is_file() and entry_path.read_text() == self._entry_json(entry)
        )

    def _run(self, entry: SuiteRun, folder: Path) -> str:
        """Execute and evaluate a run; return the reason if it fails, else an empty string."""
        settings = [
            word for setting in (*self.settings, *entry.settings) for word in ("--set", setting)
        ]
        run = ("run", entry.source, "--out", str(folder), "--overwrite", *self.suite.options())
        if entry.front_end_folder:
            run += ("--reuse-front-end", str(self.out / entry.front_end_folder))
        elif self.suite.front_end:
            run += ("--keep-front-end",)
        for name in (ENTRY, RESULTS):  # `ldo run --overwrite` refuses files that it did not write.
            (folder / name).unlink(missing_ok=True)
        done = _ldo(*run, *settings)
        if done.returncode:
            return _reason(done)
        evaluated = _ldo("eval", str(folder), entry.source, "--json")
        if evaluated.returncode:
            return _reason(evaluated)
        _write(folder / RESULTS, evaluated.stdout)
        # This file marks the run as finished, so it is written last.
        _write(folder / ENTRY, self._entry_json(entry))
        return ""


def read_evaluated_run(folder: Path) -> EvaluatedRun:
    """Return the results of a finished run.

    Raises:
        ConfigError: A file with results cannot be read.
    """
    try:
        texts = [(folder / name).read_text() for name in ("summary.json", RESULTS)]
        return EvaluatedRun(*map(json.loads, texts))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{folder} has no valid results ({error}). Remove this folder, and start the suite "
            "again to repeat the run."
        ) from error


def _ldo(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*LDO, *words], capture_output=True, text=True, check=False)


def _reason(done: subprocess.CompletedProcess[str]) -> str:
    """Return the error message that a failed `ldo` process has printed."""
    lines = [line for line in done.stderr.strip().splitlines() if line.strip()]
    return lines[-1].removeprefix("ldo: ") if lines else f"exit code {done.returncode}."


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}.") from error
