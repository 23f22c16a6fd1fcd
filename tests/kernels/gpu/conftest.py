"""Fixture and summary that the tests of the GPU kernels share."""

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from tests.kernels.gpu import agreement


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


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send the differences of a worker of pytest-xdist to the main process."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["differences"] = agreement.measured


class Collector:
    """Collector of the differences that the workers of pytest-xdist measured."""

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        for kind, errors in getattr(node, "workeroutput", {}).get("differences", {}).items():
            agreement.measured.setdefault(kind, []).extend(map(tuple, errors))


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Collector())


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    lines = agreement.summary()
    if lines:
        terminalreporter.section("largest differences")
        terminalreporter.write_line("\n".join(lines))
