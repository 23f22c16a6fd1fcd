"""Comparison of this checkout with another one: a process for each, and turns between them."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PROGRAM = Path(__file__).with_name("checkout_worker.py")


class Worker:
    """Process that runs `checkout_worker.py` on one thread, with the code of a checkout.

    Args:
        checkout: Root of the checkout, with its environment in `.venv`; None for this checkout.
        arguments: Arguments of the program.
    """

    def __init__(self, checkout: Path | None, *arguments: str) -> None:
        root = (checkout or ROOT).resolve()
        python = root / ".venv/bin/python" if checkout else Path(sys.executable)
        threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [python, PROGRAM, *arguments],
            cwd=root,
            env=os.environ | threads | {"PYTHONPATH": str(root)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, task: str) -> dict[str, Any]:
        """Run a task, and return the answer of the process.

        Raises:
            SystemExit: The process ended.
        """
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(f"{task}\n")
        stdin.flush()
        line = stdout.readline()
        if not line:
            raise SystemExit(f"the worker process ended with status {self._process.wait()}.")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        self._process.communicate()


@contextmanager
def workers(
    places: list[tuple[Path | None, tuple[str, ...]]],
) -> Iterator[list[Worker]]:
    """Start a worker for each checkout and its arguments; they end with the `with` block."""
    with ExitStack() as stack:
        started = [Worker(checkout, *arguments) for checkout, arguments in places]
        for worker in started:
            stack.callback(worker.close)
        yield started


def turn(started: list[Worker], number: int, task: str) -> list[dict[str, Any]]:
    """Give a task to each worker in turn, and return the answers in the order of the workers.

    Odd turns run in reverse order, so that no worker always follows the same other one.
    """
    order = range(len(started)) if number % 2 == 0 else reversed(range(len(started)))
    answers = {place: started[place].run(task) for place in order}
    return [answers[place] for place in range(len(started))]
