"""Labels in a file come back to the bit, and nothing else is taken for them."""

from pathlib import Path

import numpy as np
import pytest

from ldo_service.detection.vocabulary import FIRST_NAMES
from ldo_service.errors import DataError
from ldo_service.semantics.gaussian_labels import (
    LabelConfig,
    Observations,
    fields,
    new_labels,
    observe,
)
from ldo_service.semantics.semantics_file import read_semantics, write_semantics

N = 50


def seen(times: int = 8) -> np.ndarray:
    """Labels of Gaussians after some keyframes, a few of them never seen."""
    rng, labels = np.random.default_rng(0), new_labels(N)
    for _ in range(times):
        indices = np.flatnonzero(rng.random(N - 5) < 0.6).astype(np.uint32)
        said = rng.integers(-1, len(FIRST_NAMES), len(indices)).astype(np.int16)
        numbers = rng.random((2, len(indices)), np.float32)
        observe(labels, Observations(indices, said, *numbers), LabelConfig())
    return labels


@pytest.fixture
def written(tmp_path: Path) -> Path:
    write_semantics(tmp_path / "semantics.npz", seen(), FIRST_NAMES)
    return tmp_path / "semantics.npz"


def rewritten(path: Path, **changed: np.ndarray) -> None:
    with np.load(path) as file:
        arrays = {**file, **changed}
    np.savez(path, **arrays)


def test_labels_come_back_to_the_bit(written: Path) -> None:
    saved = read_semantics(written, N)
    assert saved.labels.tobytes() == seen().tobytes()
    assert saved.names == FIRST_NAMES


def test_numpy_alone_reads_what_each_gaussian_is(written: Path) -> None:
    with np.load(written) as file:
        weights, ids, names = file["weights"], file["ids"], file["names"]
    row = int(np.argmax(weights[:, 0]))
    record = fields(seen())[row]
    assert str(names[ids[row, 0]]) == FIRST_NAMES[record["ids"][0]]
    assert np.all(weights.sum(axis=1) <= 1 + 1e-6)


def test_the_same_labels_make_the_same_file(written: Path, tmp_path: Path) -> None:
    write_semantics(tmp_path / "again.npz", seen(), FIRST_NAMES)
    assert (tmp_path / "again.npz").read_bytes() == written.read_bytes()


def test_labels_of_another_map_are_refused(written: Path) -> None:
    with pytest.raises(DataError, match="labels 50 Gaussians, but the map next to it has 51"):
        read_semantics(written, N + 1)


@pytest.mark.parametrize("keep", [0, 10, 300, -30])
def test_a_truncated_file_is_refused(written: Path, keep: int) -> None:
    written.write_bytes(written.read_bytes()[:keep])
    with pytest.raises(DataError, match="cannot be read as labels"):
        read_semantics(written)


def test_a_damaged_file_is_refused(written: Path) -> None:
    body = bytearray(written.read_bytes())
    body[len(body) // 2] ^= 0xFF
    written.write_bytes(body)
    with pytest.raises(DataError, match=r"semantics\.npz"):
        read_semantics(written)


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"misses": np.zeros(N - 1, np.uint8)}, "misses is uint8"),
        ({"weights": np.zeros((N, 5))}, "weights is float64"),
        ({"weights": np.full((N, 5), np.nan, np.float32)}, "must be finite and not negative"),
        ({"names": np.array(FIRST_NAMES[:2])}, "has 2 names"),
        ({"names": np.array(["a"] * 300)}, "has 300 names"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(written: Path, changed: dict, complaint: str) -> None:
    rewritten(written, **changed)
    with pytest.raises(DataError, match=complaint):
        read_semantics(written)


def test_something_else_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(DataError, match="cannot be read as labels"):
        read_semantics(tmp_path / "other.npz")
