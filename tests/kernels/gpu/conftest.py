"""Fixture and summary that the tests of the GPU kernels share."""

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from tests.kernels.gpu.agreement import summary


@pytest.fixture(autouse=True)
def _arithmetic_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Compute with NaN and infinity as a GPU does, and without warnings.

    The maximum and the minimum of NaN and a number are the number on a GPU. In the interpreter of
    Triton, they are NaN.
    """
    if find_spec("triton") is not None:
        from triton.runtime.interpreter import InterpreterBuilder

        def maximum(builder: Any, one: Any, other: Any) -> Any:
            return builder.binary_op(one, other, np.fmax)

        def minimum(builder: Any, one: Any, other: Any) -> Any:
            return builder.binary_op(one, other, np.fmin)

        monkeypatch.setattr(InterpreterBuilder, "create_maxnumf", maximum)
        monkeypatch.setattr(InterpreterBuilder, "create_minnumf", minimum)
    with np.errstate(all="ignore"):
        yield


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    lines = summary()
    if lines:
        terminalreporter.section("largest differences")
        terminalreporter.write_line("\n".join(lines))
