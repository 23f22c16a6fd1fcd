"""Tests of the Adam kernel against a NumPy implementation of ten lines."""

from collections.abc import Callable

import numpy as np
import pytest

from ldo_service.kernels import _adam

RATES = np.linspace(0, 0.1, 16).astype(np.float32)
BETA1, BETA2, EPSILON = 0.9, 0.95, 1e-8
STEP_ALL = """
from ldo_service.kernels import _adam
names = ("rows", "mean", "square", "steps")
result = {name: given[name] for name in names}
for k in range(6):
    which, gradients = given[f"which{k}"], given[f"gradients{k}"]
    _adam.adam_step(*result.values(), which, gradients, given["rates"], 0.9, 0.95, 1e-8, 2)
"""


def adam_reference(state: dict, which: np.ndarray, gradients: np.ndarray) -> None:
    """Apply Kingma and Ba 2015, algorithm 1, in float64 to the rows with any gradient."""
    which, g = which[gradients.any(axis=1)], gradients[gradients.any(axis=1)].astype(float)
    state["steps"][which] += 1
    t = state["steps"][which, None]
    state["mean"][which] = BETA1 * state["mean"][which] + (1 - BETA1) * g
    state["square"][which] = BETA2 * state["square"][which] + (1 - BETA2) * g**2
    mean, square = state["mean"][which] / (1 - BETA1**t), state["square"][which] / (1 - BETA2**t)
    state["rows"][which] -= RATES.astype(float) * mean / (np.sqrt(square) + EPSILON)


def state_of(n: int) -> dict[str, np.ndarray]:
    """Return the state of n random rows before their first step."""
    rng = np.random.default_rng(0)
    zeros = np.zeros((n, 16), np.float32)
    rows = rng.normal(size=(n, 16)).astype(np.float32)
    return {"rows": rows, "mean": zeros, "square": zeros.copy(), "steps": np.zeros(n, np.int32)}


def gradients_of(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients of about half of n rows; a tenth of these gradients are zero."""
    rng = np.random.default_rng(seed)
    which = np.flatnonzero(rng.uniform(size=n) < 0.5).astype(np.uint32)
    gradients = rng.normal(size=(len(which), 16)).astype(np.float32)
    gradients[rng.uniform(size=len(which)) < 0.1] = 0
    return which, gradients


def test_kernel_agrees_with_its_plain_twin(with_isa: Callable) -> None:
    given = state_of(70) | {"rates": RATES}
    expected = {name: state_of(70)[name].astype(float) for name in ("rows", "mean", "square")}
    expected["steps"] = np.zeros(70, int)
    for k in range(6):
        given[f"which{k}"], given[f"gradients{k}"] = gradients_of(70, k)
        adam_reference(expected, given[f"which{k}"], given[f"gradients{k}"])
    actual = with_isa(STEP_ALL, given)
    np.testing.assert_array_equal(actual["steps"], expected["steps"])
    for name in ("rows", "mean", "square"):
        np.testing.assert_allclose(actual[name], expected[name], rtol=2e-5, atol=1e-6)


def test_rows_without_a_gradient_stay_bit_for_bit() -> None:
    state = state_of(50)
    _adam.adam_step(*state.values(), *gradients_of(50, 1), RATES, BETA1, BETA2, EPSILON)
    before = {name: array.copy() for name, array in state.items()}
    which, gradients = gradients_of(50, 2)
    _adam.adam_step(*state.values(), which, gradients, RATES, BETA1, BETA2, EPSILON)
    untouched = np.setdiff1d(np.arange(50), which[gradients.any(axis=1)])
    assert 0 < len(untouched) < 50
    for name, array in state.items():
        assert array[untouched].tobytes() == before[name][untouched].tobytes()
    assert not np.array_equal(state["rows"], before["rows"])


def test_step_count_far_beyond_the_table_of_corrections_is_as_good_as_infinite() -> None:
    state = state_of(1)
    state["steps"][:] = 2_000_000
    state["square"][:] = 1
    which, gradients = np.zeros(1, np.uint32), np.ones((1, 16), np.float32)
    before = state["rows"].copy()
    _adam.adam_step(*state.values(), which, gradients, RATES, BETA1, BETA2, EPSILON)
    np.testing.assert_allclose(before - state["rows"], 0.1 * RATES[None], rtol=1e-3, atol=1e-7)


def test_number_of_threads_changes_no_bit() -> None:
    states = [state_of(30_000) for _ in range(2)]
    for state, threads in zip(states, (1, 3), strict=True):
        for k in range(2):
            _adam.adam_step(
                *state.values(), *gradients_of(30_000, k), RATES, BETA1, BETA2, EPSILON, threads
            )
    for one, many in zip(*(state.values() for state in states), strict=True):
        assert one.tobytes() == many.tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": np.zeros((5, 14), np.float32)}, r"\[N, 16\]"),
        ({"mean": np.zeros((4, 16), np.float32)}, "mean"),
        ({"square": np.zeros((5, 16))}, "square must be float32"),
        ({"steps": np.zeros(5)}, "steps must be int32"),
        ({"indices": np.array([1, 5], np.uint32)}, "below the number of rows"),
        ({"indices": np.array([3, 3], np.uint32)}, "ascend"),
        ({"indices": np.array([3, 4])}, "indices must be uint32"),
        ({"gradients": np.zeros((3, 16), np.float32)}, "gradients"),
        ({"rates": np.full(16, -1, np.float32)}, "rates"),
        ({"beta2": 1.0}, "beta"),
        ({"epsilon": 0.0}, "epsilon"),
        ({"threads": 0}, "threads"),
    ],
)
def test_bad_arguments_raise_value_error(change: dict, message: str) -> None:
    given = state_of(5) | {
        "indices": np.array([1, 4], np.uint32),
        "gradients": np.ones((2, 16), np.float32),
        "rates": RATES,
        "beta1": BETA1,
        "beta2": BETA2,
        "epsilon": EPSILON,
    }
    _adam.adam_step(**given)
    with pytest.raises(ValueError, match=message):
        _adam.adam_step(**given | change)
