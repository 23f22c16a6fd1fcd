import pytest

from ldo_service.errors import RestartsExhausted
from ldo_service.runtime.supervision_policy import RestartBudget


def test_restart_delay_doubles_within_the_window_up_to_a_limit() -> None:
    budget = RestartBudget("mapper", 5, window_s=60, delay_s=0.5, delay_max_s=3)
    assert [budget.record_failure(now_s) for now_s in range(5)] == [0.5, 1, 2, 3, 3]


def test_restarts_beyond_the_budget_are_refused() -> None:
    budget = RestartBudget("mapper", 2, window_s=60, delay_s=0, delay_max_s=1)
    budget.record_failure(0)
    budget.record_failure(1)
    with pytest.raises(RestartsExhausted, match="mapper failed 3 times within 60 s"):
        budget.record_failure(2)


def test_failures_before_the_window_do_not_count() -> None:
    budget = RestartBudget("mapper", 1, window_s=10, delay_s=0.5, delay_max_s=1)
    assert [budget.record_failure(now_s) for now_s in (0, 11, 22, 33)] == [0.5] * 4


def test_large_budget_does_not_overflow() -> None:
    budget = RestartBudget("mapper", 10_000, window_s=1e9, delay_s=0.1, delay_max_s=1)
    assert [budget.record_failure(0) for _ in range(5_000)][-1] == 1
