"""Benchmarks are run by hand, seldom: what they import must still be there."""

from importlib import import_module
from pathlib import Path

import pytest

PROGRAMS = sorted(path.stem for path in Path(__file__).parent.glob("bench/bench_*.py"))


def test_there_are_benchmarks() -> None:
    assert PROGRAMS


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_benchmark_can_be_started(program: str) -> None:
    assert callable(import_module(f"tests.bench.{program}").main)
