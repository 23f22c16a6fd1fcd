"""semantics.npz: what each Gaussian of a map.ply is, row by row.

names     [C] text           of the labels, by index: background, other, ...
weights   [N, 5] float32     of the five likeliest labels, heaviest first; background has the rest
ids       [N, 5] uint8       the labels that the weights belong to; of a weight of 0 none
evidence  [N] float32        how much was seen: the sum of the weights of observations, faded
extent_mm [N] uint16         side of the object that it was last seen as a part of
misses    [N] uint8          keyframes since then that expected it to be one
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import DataError
from ldo_service.gaussians.model import new_labels
from ldo_service.storage.arrays_file import UNREADABLE, read_arrays

from .gaussian_labels import MAX_LABELS, ROW, fields

COLUMNS = ROW.names or ()
MAX_BYTES = 1 << 32  # of 128 million Gaussians


@dataclass(frozen=True, eq=False, slots=True)
class SavedSemantics:
    """labels [N, 32], see `labels`; names by index."""

    labels: np.ndarray
    names: tuple[str, ...]


def write_semantics(path: Path, labels: np.ndarray, names: tuple[str, ...]) -> None:
    """Labels [N, 32] in the order of the Gaussians in the map beside it."""
    rows = fields(labels)
    columns: dict[str, Any] = {name: rows[name] for name in COLUMNS}
    with path.open("wb") as file:
        np.savez_compressed(file, names=np.array(names, np.str_), **columns)


def read_semantics(path: Path, gaussians: int | None = None) -> SavedSemantics:
    """What `write_semantics` wrote, bit for bit.

    gaussians  how many the map beside it has
    Raises DataError for a file that cannot be read, is something else, or fits another map.
    """
    try:
        saved = read_arrays(path, MAX_BYTES)
        arrays = {name: saved[name] for name in ("names", *COLUMNS)}
    except UNREADABLE as error:
        raise DataError(f"{path} cannot be read as labels: {error}") from error
    labels = new_labels(len(arrays["weights"]))
    for name in COLUMNS:
        _require(path, name, arrays[name], len(labels))
        fields(labels)[name] = arrays[name]
    names = tuple(arrays["names"].tolist())
    _require_names(path, labels, names)
    if gaussians is not None and len(labels) != gaussians:
        raise DataError(
            f"{path} labels {len(labels)} Gaussians, the map beside it has {gaussians}: they are "
            "not of one run."
        )
    return SavedSemantics(labels, names)


def _require(path: Path, name: str, values: np.ndarray, count: int) -> None:
    base, shape = ROW[name].base, (count, *ROW[name].shape)
    if values.dtype != base or values.shape != shape:
        raise DataError(f"{path}: {name} is {values.dtype}{values.shape}, must be {base}{shape}.")
    if values.dtype.kind == "f" and not (np.isfinite(values).all() and (values >= 0).all()):
        raise DataError(f"{path}: {name} holds NaN, infinity or negative numbers.")


def _require_names(path: Path, labels: np.ndarray, names: tuple[str, ...]) -> None:
    rows = fields(labels)
    last = int(rows["ids"][rows["weights"] > 0].max(initial=0))
    if not last < len(names) <= MAX_LABELS:
        raise DataError(f"{path} names {len(names)} labels, and uses number {last}.")
