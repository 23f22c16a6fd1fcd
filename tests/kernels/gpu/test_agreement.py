from types import SimpleNamespace

import pytest

from tests.kernels.gpu import agreement
from tests.kernels.gpu.conftest import Collector


def test_summary_has_the_differences_of_all_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agreement, "measured", {})
    agreement.check("loss to C++", 1e-7, "here")
    for where, error in (("one worker", 3e-7), ("another worker", 2e-7)):
        sent = {"differences": {"loss to C++": [[error, where]]}}
        Collector().pytest_testnodedown(SimpleNamespace(workeroutput=sent))
    Collector().pytest_testnodedown(SimpleNamespace())  # This worker crashed.
    (line,) = agreement.summary()
    assert "3.0e-07, median 2.0e-07 (one worker)" in line
