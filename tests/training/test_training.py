"""Learning rate, optimizer and crop sizes of a training run."""

import sys
from collections.abc import Iterator
from itertools import islice, repeat
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

pytest.importorskip("jax", reason="needs the trainer's libraries: pip install --group train")


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "training")
    import training

    yield training
    for name in ("training", "layers"):
        sys.modules.pop(name, None)


def test_rate_rises_stays_constant_and_falls_to_zero(training: ModuleType) -> None:
    steps = 2000
    paces = np.array([training.pace(number, steps) for number in range(1, steps + 1)])
    assert (np.diff(paces[: training.WARM_UP_STEPS]) > 0).all()
    level = slice(training.WARM_UP_STEPS, round((1 - training.FALL) * steps))
    assert (paces[level] == 1).all()
    assert (np.diff(paces[level.stop + 1 :]) < 0).all()
    assert 0 < paces[-1] < 0.01


def test_fit_finds_the_minimum_and_keeps_the_start_weights(training: ModuleType) -> None:
    start = {"x.kernel": np.array([3.0, -2.0], np.float32)}

    def loss(weights: dict, batch: np.ndarray):
        return ((weights["x.kernel"] - batch) ** 2).sum()

    goal = np.array([1.0, 0.5], np.float32)
    found = training.fit_in_rounds(
        loss, start, [iter([goal] * 900) for _ in range(2)], (900, 100), 0.2
    )
    np.testing.assert_allclose(found["x.kernel"], goal, atol=0.05)
    assert start["x.kernel"].tolist() == [3.0, -2.0]


def test_crops_grow_after_their_fractions_of_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "training")
    before = set(sys.modules)
    import pair

    try:
        sides = islice(pair.growing(repeat, ((32, 0.3), (48, 0.7)), 10), 14)
        assert list(sides) == [32] * 3 + [48] * 11
    finally:
        for name in set(sys.modules) - before:
            if Path(getattr(sys.modules[name], "__file__", None) or "").parent.name == "networks":
                del sys.modules[name]
