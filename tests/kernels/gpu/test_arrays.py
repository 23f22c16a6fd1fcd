from typing import Any

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.kernels.gpu.arrays import Arrays, HostArrays, TorchArrays


@pytest.fixture(params=["host", "torch"])
def arrays(request: pytest.FixtureRequest) -> Arrays:
    """Return arrays in NumPy, and arrays in torch on the CPU."""
    if request.param == "host":
        return HostArrays()
    pytest.importorskip("torch", reason="install torch to test the arrays of a GPU on the CPU")
    return TorchArrays("cpu")


def placed(arrays: Arrays, *values: int) -> Any:
    return arrays.upload(np.array(values, np.int32))


def test_download_returns_the_uploaded_values(arrays: Arrays) -> None:
    for dtype in (np.float32, np.int32, np.uint8):
        values = np.arange(6).reshape(2, 3).astype(dtype)
        values.flags.writeable = False
        array = arrays.upload(values)
        got = arrays.download(array)
        np.testing.assert_array_equal(got, values)
        assert got.dtype == dtype
        got[:] = 0  # Both are copies.
        np.testing.assert_array_equal(arrays.download(array), values)


def test_new_arrays_have_shape_and_type(arrays: Arrays) -> None:
    zeros = arrays.download(arrays.zeros((2, 3), np.float32))
    np.testing.assert_array_equal(zeros, np.zeros((2, 3), np.float32))
    empty = arrays.download(arrays.empty((4, 0), np.int32))
    assert empty.shape == (4, 0)
    assert empty.dtype == np.int32


def test_nonzero_returns_ascending_places(arrays: Arrays) -> None:
    got = arrays.download(arrays.nonzero(placed(arrays, 0, 3, 0, 1, 2)))
    np.testing.assert_array_equal(got, np.array([1, 3, 4], np.int32))
    assert got.dtype == np.int32


def test_equal_keys_keep_their_order(arrays: Arrays) -> None:
    keys = np.random.default_rng(0).integers(0, 5, 1000).astype(np.int32)
    got = arrays.download(arrays.stable_order(arrays.upload(keys)))
    wanted = sorted(range(1000), key=lambda i: (keys[i], i))
    np.testing.assert_array_equal(got, wanted)
    assert got.dtype == np.int32


def test_take_and_put_select_rows(arrays: Arrays) -> None:
    rows = arrays.upload(np.arange(8, dtype=np.float32).reshape(4, 2))
    taken = arrays.take(rows, placed(arrays, 3, 0))
    np.testing.assert_array_equal(arrays.download(taken), [[6, 7], [0, 1]])
    arrays.put(rows, placed(arrays, 1, 2), taken)
    np.testing.assert_array_equal(arrays.download(rows), [[0, 1], [6, 7], [0, 1], [6, 7]])


def test_offsets_are_the_sums_before_each_count(arrays: Arrays) -> None:
    offsets, total = arrays.offsets(placed(arrays, 2, 0, 3))
    np.testing.assert_array_equal(arrays.download(offsets), [0, 2, 2])
    assert arrays.download(offsets).dtype == np.int32
    assert total == 5
    assert arrays.offsets(placed(arrays))[1] == 0


def test_sum_of_counts_beyond_int32_raises_an_error(arrays: Arrays) -> None:
    half = 2**30
    assert arrays.offsets(placed(arrays, half, half - 1))[1] == 2**31 - 1
    with pytest.raises(ConfigError, match=r"2147483648 pairs .* at most 2147483647 .*max_resident"):
        arrays.offsets(placed(arrays, half, half))


def test_repeat_gives_each_value_as_often_as_its_count(arrays: Arrays) -> None:
    values, counts = placed(arrays, 7, 8, 9), placed(arrays, 2, 0, 3)
    got = arrays.download(arrays.repeat(values, counts, 5))
    np.testing.assert_array_equal(got, [7, 7, 9, 9, 9])


def test_starts_are_the_first_places_of_each_value(arrays: Arrays) -> None:
    got = arrays.download(arrays.starts(placed(arrays, 0, 0, 2, 2, 2), 3))
    np.testing.assert_array_equal(got, np.array([0, 2, 2, 5], np.int32))
    assert got.dtype == np.int32


def test_missing_torch_raises_an_error_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "torch", None)
    with pytest.raises(ConfigError, match=r"need torch.*\[cuda\]"):
        TorchArrays("cuda")
