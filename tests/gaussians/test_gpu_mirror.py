"""The copy of a map on a device, with arrays in NumPy instead of a device."""

import numpy as np
import pytest

from ldo_service.errors import DeviceError
from ldo_service.gaussians import GaussianMap
from ldo_service.gaussians.adam import Adam
from ldo_service.gaussians.gpu_mirror import GaussianMirror
from ldo_service.geometry import se3
from ldo_service.kernels.gpu.arrays import HostArrays

ARRAYS = HostArrays()


def rows_of(n: int, seed: int) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(n, 16)).astype(np.float32)
    rows[:, 14:] = 0
    return rows


def assert_equals_original(mirror: GaussianMirror, gaussians: GaussianMap, adam: Adam) -> None:
    state, n = adam.arguments(gaussians), len(gaussians)
    for array, original in (
        (mirror.rows, gaussians.rows),
        (mirror.moments, state.mean),
        (mirror.squares, state.square),
        (mirror.steps, state.steps),
    ):
        np.testing.assert_array_equal(ARRAYS.download(array)[:n], original)


def step_on_device(mirror: GaussianMirror, places: np.ndarray) -> None:
    """Change rows, moments and step counts on the device, each in another way."""
    mirror.rows.values[places] += np.float32(0.5)
    mirror.moments.values[places] = mirror.rows.values[places] * 2
    mirror.squares.values[places] = mirror.rows.values[places] ** 2
    mirror.steps.values[places] += 1


@pytest.fixture
def followed() -> tuple[GaussianMap, Adam, GaussianMirror]:
    """Return a map with 40 Gaussians of four anchors and some moments, and its mirror."""
    gaussians, adam, mirror = GaussianMap(), Adam(), GaussianMirror(ARRAYS)
    for anchor in range(4):
        gaussians.add(rows_of(10, anchor), anchor)
    mirror.update(gaussians, adam)
    step_on_device(mirror, np.arange(0, 40, 3))
    mirror.write_back(gaussians, adam)
    return gaussians, adam, mirror


def test_steps_on_the_device_reach_map_and_moments(followed: tuple) -> None:
    gaussians, adam, mirror = followed
    wanted = np.concatenate([rows_of(10, anchor) for anchor in range(4)])
    wanted[::3] += np.float32(0.5)
    np.testing.assert_array_equal(gaussians.rows, wanted)
    assert mirror.downloaded == 14
    state = adam.arguments(gaussians)
    np.testing.assert_array_equal(state.steps, np.arange(40) % 3 == 0)
    np.testing.assert_array_equal(state.mean[::3], wanted[::3] * 2)
    np.testing.assert_array_equal(state.square[::3], wanted[::3] ** 2)
    assert not state.mean[1::3].any()
    assert_equals_original(mirror, gaussians, adam)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["rows", "moments", "squares"])
def test_value_that_is_not_finite_changes_no_map(followed: tuple, name: str, value: float) -> None:
    gaussians, adam, mirror = followed
    rows, state, version = gaussians.rows.copy(), adam.snapshot(), gaussians.version
    step_on_device(mirror, np.array([2, 5]))
    getattr(mirror, name).values[5, 3] = value
    with pytest.raises(DeviceError, match="NaN or infinity in the"):
        mirror.write_back(gaussians, adam)
    np.testing.assert_array_equal(gaussians.rows, rows)
    assert gaussians.version == version
    for key, values in adam.snapshot().items():
        np.testing.assert_array_equal(values, state[key])


def test_only_changed_rows_are_uploaded(followed: tuple) -> None:
    gaussians, adam, mirror = followed
    assert mirror.uploaded == 40
    mirror.update(gaussians, adam)
    assert mirror.uploaded == 0
    gaussians.add(rows_of(7, 9), 4)
    mirror.update(gaussians, adam)
    assert mirror.uploaded == 7
    assert_equals_original(mirror, gaussians, adam)
    gaussians.move_anchors({2: se3.exp(np.array([0.1, 0.2, 0.3, 1, 2, 3]))})
    mirror.update(gaussians, adam)
    assert mirror.uploaded == 10
    assert_equals_original(mirror, gaussians, adam)
    gaussians.remove(gaussians.ids % 4 == 1)
    mirror.update(gaussians, adam)
    assert mirror.uploaded == 0
    assert_equals_original(mirror, gaussians, adam)


def test_offloaded_gaussians_return_without_moments(followed: tuple) -> None:
    gaussians, adam, mirror = followed
    taken = gaussians.extract(gaussians.anchors == 3)
    mirror.update(gaussians, adam)
    step_on_device(mirror, np.array([0, 5]))
    mirror.write_back(gaussians, adam)
    gaussians.reinsert(*taken)
    mirror.update(gaussians, adam)
    assert mirror.uploaded == 10
    assert not adam.arguments(gaussians).steps[30:].any()
    assert_equals_original(mirror, gaussians, adam)


def test_gaussians_that_leave_and_return_unseen_lose_their_moments_too(followed: tuple) -> None:
    """Adam adapts its moments to the map twice between two updates of the mirror."""
    gaussians, adam, mirror = followed
    taken = gaussians.extract(gaussians.anchors == 3)
    adam.steps(gaussians)
    gaussians.reinsert(*taken)
    adam.steps(gaussians)
    mirror.update(gaussians, adam)
    assert not adam.arguments(gaussians).steps[30:].any()
    assert_equals_original(mirror, gaussians, adam)


def test_restored_map_and_moments_are_uploaded_whole(followed: tuple) -> None:
    gaussians, adam, mirror = followed
    saved, moments = gaussians.snapshot(), adam.snapshot()
    step_on_device(mirror, np.arange(40))
    mirror.write_back(gaussians, adam)
    gaussians = GaussianMap.restore(saved)
    adam.restore(moments)
    mirror.update(gaussians, adam)
    assert mirror.uploaded == 40
    assert_equals_original(mirror, gaussians, adam)
    assert adam.arguments(gaussians).steps.max() == 1


def test_restored_moments_of_the_same_map_are_uploaded(followed: tuple) -> None:
    gaussians, adam, mirror = followed
    saved = adam.snapshot()
    step_on_device(mirror, np.arange(40))
    mirror.write_back(gaussians, adam)
    adam.restore(saved)
    mirror.update(gaussians, adam)
    assert_equals_original(mirror, gaussians, adam)


def test_additions_within_the_capacity_move_no_rows(followed: tuple) -> None:
    gaussians, adam, mirror = followed
    gaussians.add(rows_of(10, 7), 7)  # The capacity of 40 becomes 80.
    mirror.update(gaussians, adam)
    arrays = mirror.rows, mirror.moments, mirror.squares, mirror.steps
    gaussians.add(rows_of(30, 8), 8)
    mirror.update(gaussians, adam)
    assert (mirror.rows, mirror.moments, mirror.squares, mirror.steps) == arrays
    assert len(mirror.rows) == 80
    assert_equals_original(mirror, gaussians, adam)
    gaussians.add(rows_of(1, 9), 9)
    mirror.update(gaussians, adam)
    assert mirror.rows is not arrays[0]
    assert_equals_original(mirror, gaussians, adam)


def test_another_map_is_uploaded_whole(followed: tuple) -> None:
    gaussians, adam, mirror = followed
    other = GaussianMap.restore(gaussians.snapshot())
    other.rows[3] = 7
    mirror.update(other, adam)
    assert mirror.uploaded == 40
    assert_equals_original(mirror, other, adam)


def test_random_changes_of_the_map_keep_both_equal() -> None:
    rng, gaussians, adam = np.random.default_rng(0), GaussianMap(capacity=4), Adam()
    mirror, offloaded = GaussianMirror(ARRAYS), []
    for round_number in range(60):
        for change in rng.integers(0, 6, rng.integers(0, 4)):
            n = len(gaussians)
            if change <= 1:
                gaussians.add(rows_of(int(rng.integers(1, 30)), round_number), round_number)
            elif change == 2 and n:
                gaussians.remove(rng.random(n) < 0.2)
            elif change == 3 and n:
                offloaded.append(gaussians.extract(rng.random(n) < 0.3))
            elif change == 4 and offloaded:
                gaussians.reinsert(*offloaded.pop(int(rng.integers(len(offloaded)))))
            elif change == 5 and n:
                gaussians.move_anchors({int(gaussians.anchors[-1]): se3.exp(rng.normal(size=6))})
            if rng.random() < 0.2:
                adam.steps(gaussians)
        mirror.update(gaussians, adam)
        assert_equals_original(mirror, gaussians, adam)
        if len(gaussians):
            step_on_device(mirror, rng.permutation(len(gaussians))[: len(gaussians) // 2])
        mirror.write_back(gaussians, adam)
        assert_equals_original(mirror, gaussians, adam)
    assert len(gaussians) > 50
