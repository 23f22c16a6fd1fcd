"""Semantics file: round trip and rejection of invalid files."""

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


def random_labels(times: int = 8) -> np.ndarray:
    """Return labels of Gaussians after some keyframes; a few were never observed."""
    rng, labels = np.random.default_rng(0), new_labels(N)
    for _ in range(times):
        indices = np.flatnonzero(rng.random(N - 5) < 0.6).astype(np.uint32)
        observed = rng.integers(-1, len(FIRST_NAMES), len(indices)).astype(np.int16)
        numbers = rng.random((2, len(indices)), np.float32)
        observe(labels, Observations(indices, observed, *numbers), LabelConfig())
    return labels


@pytest.fixture
def semantics_file(tmp_path: Path) -> Path:
    write_semantics(tmp_path / "semantics.npz", random_labels(), FIRST_NAMES)
    return tmp_path / "semantics.npz"


def rewrite(path: Path, **changed: np.ndarray) -> None:
    with np.load(path) as file:
        arrays = {**file, **changed}
    np.savez(path, **arrays)


def test_labels_are_read_back_bitwise_equal(semantics_file: Path) -> None:
    saved = read_semantics(semantics_file, N)
    assert saved.labels.tobytes() == random_labels().tobytes()
    assert saved.names == FIRST_NAMES


def test_file_is_readable_with_numpy_alone(semantics_file: Path) -> None:
    with np.load(semantics_file) as file:
        weights, ids, names = file["weights"], file["ids"], file["names"]
    row = int(np.argmax(weights[:, 0]))
    record = fields(random_labels())[row]
    assert str(names[ids[row, 0]]) == FIRST_NAMES[record["ids"][0]]
    assert np.all(weights.sum(axis=1) <= 1 + 1e-6)


def test_equal_labels_give_bitwise_equal_files(semantics_file: Path, tmp_path: Path) -> None:
    write_semantics(tmp_path / "again.npz", random_labels(), FIRST_NAMES)
    assert (tmp_path / "again.npz").read_bytes() == semantics_file.read_bytes()


def test_labels_of_another_map_raise(semantics_file: Path) -> None:
    with pytest.raises(DataError, match="labels 50 Gaussians, but the map next to it has 51"):
        read_semantics(semantics_file, N + 1)


@pytest.mark.parametrize("keep", [0, 10, 300, -30])
def test_truncated_file_raises(semantics_file: Path, keep: int) -> None:
    semantics_file.write_bytes(semantics_file.read_bytes()[:keep])
    with pytest.raises(DataError, match="cannot be read as labels"):
        read_semantics(semantics_file)


def test_damaged_file_raises(semantics_file: Path) -> None:
    body = bytearray(semantics_file.read_bytes())
    body[len(body) // 2] ^= 0xFF
    semantics_file.write_bytes(body)
    with pytest.raises(DataError, match=r"semantics\.npz"):
        read_semantics(semantics_file)


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
def test_invalid_arrays_raise(semantics_file: Path, changed: dict, complaint: str) -> None:
    rewrite(semantics_file, **changed)
    with pytest.raises(DataError, match=complaint):
        read_semantics(semantics_file)


def test_file_without_labels_raises(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", weights=np.zeros(3))
    with pytest.raises(DataError, match="cannot be read as labels"):
        read_semantics(tmp_path / "other.npz")
