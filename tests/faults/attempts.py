"""Tests of all attempts in the tables of docs/benchmarks/faults.md, with a verdict for each one.

    .venv/bin/python -m tests.faults.attempts
    .venv/bin/python -m tests.faults.attempts idle        (attempts whose text contains a word)

An attempt is SEEN if the fault still occurs: one of its tests fails. It is NOT SEEN if all of them
pass, and SKIPPED if this machine cannot run one of them.
"""

import argparse
import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/benchmarks/faults.md"


def attempts(page: str) -> dict[str, list[str]]:
    """Return the names of the tests of each attempt, by its text.

    Args:
        page: Text of the page. A table of attempts has the columns attempt (or fault), before, now
            and test.
    """
    found: dict[str, list[str]] = {}
    is_inside = False
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if cells[1:] == ["before", "now", "test"]:
            is_inside = True
        elif not line.startswith("|"):
            is_inside = False
        elif is_inside and set(line) - set("|- "):
            found[cells[0]] = re.findall(r"`(test_\w+)`", cells[-1])
    return found


def files_of_tests() -> dict[str, list[Path]]:
    """Return the files that define each test, by the name of the test."""
    files = defaultdict[str, list[Path]](list)
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for name in re.findall(r"^ *(?:async )?def (test_\w+)", path.read_text(), re.MULTILINE):
            files[name].append(path)
    return files


class _Outcomes:
    """Pytest plugin that keeps the outcomes of each test, by its name without parameters."""

    def __init__(self) -> None:
        self.of = defaultdict[str, set[str]](set)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" or report.outcome != "passed":
            self.of[report.nodeid.rpartition("::")[2].partition("[")[0]].add(report.outcome)


def verdict(outcomes: Iterable[set[str]]) -> str:
    """Return the verdict of an attempt from the outcomes of each of its tests."""
    outcomes = list(outcomes)
    if any("failed" in of for of in outcomes):
        return "SEEN"
    return "NOT SEEN" if outcomes and all(of == {"passed"} for of in outcomes) else "SKIPPED"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("word", nargs="?", default="", help="word in the text of the attempts")
    given = parser.parse_args()
    table = {a: names for a, names in attempts(PAGE.read_text()).items() if given.word in a}
    files, outcomes = files_of_tests(), _Outcomes()
    if not table:
        parser.error(f"no attempt of {PAGE.name} contains {given.word!r}")
    tests = sorted({f"{p}::{n}" for names in table.values() for n in names for p in files[n]})
    exit_code = pytest.main(
        [*tests, "-q", "-m", "slow or not slow", "--no-header"], plugins=[outcomes]
    )
    verdicts = {a: verdict(outcomes.of[name] for name in names) for a, names in table.items()}
    for attempt, result in verdicts.items():
        print(f"{result:<9} {attempt}")
    # Pytest has another exit code if it could not run the tests.
    raise SystemExit("SEEN" in verdicts.values() or exit_code not in (0, 1))


if __name__ == "__main__":
    main()
