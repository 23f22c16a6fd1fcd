"""Fixture and summary that the tests of the GPU kernels share."""

from collections.abc import Iterator

import numpy as np
import pytest

from tests.kernels.gpu.agreement import summary


@pytest.fixture(autouse=True)
def _without_warnings_of_arithmetic() -> Iterator[None]:
    """Compute with NaN and infinity without warnings, as a GPU does."""
    with np.errstate(all="ignore"):
        yield


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    lines = summary()
    if lines:
        terminalreporter.section("largest differences")
        terminalreporter.write_line("\n".join(lines))
