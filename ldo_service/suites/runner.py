"""The runs of a suite, one after the other, each in a process of its own.

What is finished stays: a suite that was interrupted goes on where it stopped. A run that fails is
left out of the table, and does not stop the others.
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

from .suite import SYNTHETIC, Judged, Suite, SuiteRun

log = logging.getLogger(__name__)

LDO = (sys.executable, "-m", "ldo_service")
TOLD, RESULTS = "entry.json", "eval.json"


@dataclass(frozen=True, slots=True)
class Outcome:
    """judged: None where there are no figures, and `missing` says why."""

    entry: SuiteRun
    judged: Judged | None
    missing: str = ""


@dataclass(frozen=True, slots=True)
class SuiteRunner:
    """data: where the sources lie; out: where runs go; settings: of all runs, before those of a
    variant."""

    suite: Suite
    data: Path
    out: Path
    settings: tuple[str, ...] = ()
    overwrite: bool = False

    def entries(self) -> list[SuiteRun]:
        return list(self.suite.entries(self.data))

    def outcomes(self, begun: Callable[[SuiteRun], None]) -> Iterator[Outcome]:
        """Each entry when it is finished; `begun` is told before."""
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
                log.error("%s: %s", entry.folder, failed)
                return Outcome(entry, None, "failed")
        try:
            return Outcome(entry, judged_in(folder))
        except ConfigError as error:
            log.error("%s", error)
            return Outcome(entry, None, "failed")

    def _told(self, entry: SuiteRun) -> str:
        """What its figures depend on."""
        told = {
            **asdict(entry),
            "settings": (*self.settings, *entry.settings),
            "options": self.suite.options(),
            "ldo": versions()["ldo-slam"],
        }
        if self.suite.front_end is None:
            del told["front_end"]
        else:
            told["front_end_settings"] = self.suite.front_end_settings()
        return json.dumps(told, indent=1)

    def _is_finished(self, entry: SuiteRun, folder: Path) -> bool:
        told = folder / TOLD
        is_kept = entry.variant != self.suite.front_end or (folder / FRONT_END).is_file()
        return is_kept and told.is_file() and told.read_text() == self._told(entry)

    def _run(self, entry: SuiteRun, folder: Path) -> str:
        """Why it failed; empty when it did not."""
        settings = [
            word for setting in (*self.settings, *entry.settings) for word in ("--set", setting)
        ]
        run = ("run", entry.source, "--out", str(folder), "--overwrite", *self.suite.options())
        if entry.front_end_folder:
            run += ("--reuse-front-end", str(self.out / entry.front_end_folder))
        elif self.suite.front_end:
            run += ("--keep-front-end",)
        for name in (TOLD, RESULTS):  # `ldo run` replaces what it wrote, and nothing else
            (folder / name).unlink(missing_ok=True)
        done = _ldo(*run, *settings)
        if done.returncode:
            return _reason(done)
        judged = _ldo("eval", str(folder), entry.source, "--json")
        if judged.returncode:
            return _reason(judged)
        _write(folder / RESULTS, judged.stdout)
        _write(folder / TOLD, self._told(entry))  # last: now it is finished
        return ""


def judged_in(folder: Path) -> Judged:
    """Raises ConfigError when a file is no longer what was written."""
    try:
        texts = [(folder / name).read_text() for name in ("summary.json", RESULTS)]
        return Judged(*map(json.loads, texts))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{folder}: {error}. Remove the folder to run it again.") from error


def _ldo(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*LDO, *words], capture_output=True, text=True, check=False)


def _reason(done: subprocess.CompletedProcess[str]) -> str:
    """The paragraph in which `ldo` says what was wrong."""
    lines = [line for line in done.stderr.strip().splitlines() if line.strip()]
    return lines[-1].removeprefix("ldo: ") if lines else f"it ended with code {done.returncode}"


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}.") from error
