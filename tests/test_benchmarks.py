"""Benchmarks, which are run by hand: their imports must still resolve."""

from importlib import import_module
from pathlib import Path

import pytest

PROGRAMS = sorted(path.stem for path in Path(__file__).parent.glob("bench/bench_*.py"))


def test_benchmarks_exist() -> None:
    assert PROGRAMS


@pytest.mark.parametrize("program", PROGRAMS)
def test_benchmark_imports_and_has_main(program: str) -> None:
    assert callable(import_module(f"tests.bench.{program}").main)
