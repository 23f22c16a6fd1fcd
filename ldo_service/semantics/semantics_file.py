"""Reader and writer of semantics.npz, which has the label distribution of each Gaussian of a run.

The file has C names of labels, and one row for each of the N Gaussians of map.ply, in its order:

names     [C] text           names of the labels, by index: background, other, ...
weights   [N, 5] float32     five highest probabilities, highest first; background has the rest
ids       [N, 5] uint8       indices of the labels with these probabilities; unused for weight 0
evidence  [N] float32        sum of the weights of all label observations, decayed with age
extent_mm [N] uint16         size of the object, mm, when a label was last observed
misses    [N] uint8          keyframes that showed the Gaussian in no region since its last label
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
MAX_BYTES = 1 << 32  # Maximum size of the arrays, enough for 128 million Gaussians.


@dataclass(frozen=True, eq=False, slots=True)
class SavedSemantics:
    """Contents of a semantics.npz.

    Attributes:
        labels: Label rows of the Gaussians, [N, 32] uint8, see `gaussian_labels.ROW`.
        names: Names of the labels, by index.
    """

    labels: np.ndarray
    names: tuple[str, ...]


def write_semantics(path: Path, labels: np.ndarray, names: tuple[str, ...]) -> None:
    """Write the labels of the Gaussians of a map.

    Args:
        path: The file.
        labels: Label rows of the Gaussians in the order of map.ply, [N, 32] uint8, see
            `gaussian_labels.ROW`.
        names: Names of the labels, by index.
    """
    rows = fields(labels)
    columns: dict[str, Any] = {name: rows[name] for name in COLUMNS}
    with path.open("wb") as file:
        np.savez_compressed(file, names=np.array(names, np.str_), **columns)


def read_semantics(path: Path, gaussians: int | None = None) -> SavedSemantics:
    """Read a file that `write_semantics` wrote; all values are restored exactly.

    Args:
        path: The file.
        gaussians: Required number of Gaussians: that of the map.ply of the same run. None: the
            number is not checked.

    Raises:
        DataError: If the file cannot be read, has another format, or has another number of
            Gaussians.
    """
    try:
        saved = read_arrays(path, MAX_BYTES)
        arrays = {name: saved[name] for name in ("names", *COLUMNS)}
    except UNREADABLE as error:
        raise DataError(
            f"{path} cannot be read as labels of a map: {error}. Use the semantics.npz of a run."
        ) from error
    labels = new_labels(len(arrays["weights"]))
    for name in COLUMNS:
        _require(path, name, arrays[name], len(labels))
        fields(labels)[name] = arrays[name]
    names = tuple(arrays["names"].tolist())
    _require_names(path, labels, names)
    if gaussians is not None and len(labels) != gaussians:
        raise DataError(
            f"{path} labels {len(labels)} Gaussians, but the map next to it has {gaussians}. "
            "Use the map.ply and semantics.npz of one run."
        )
    return SavedSemantics(labels, names)


def _require(path: Path, name: str, values: np.ndarray, count: int) -> None:
    base, shape = ROW[name].base, (count, *ROW[name].shape)
    if values.dtype != base or values.shape != shape:
        raise DataError(
            f"{path}: the array {name} is {values.dtype}{values.shape}, but must be {base}{shape}. "
            "Use the semantics.npz of a run."
        )
    if values.dtype.kind == "f" and not (np.isfinite(values).all() and (values >= 0).all()):
        raise DataError(
            f"{path}: the array {name} has negative numbers, NaN or infinity, but its numbers must "
            "be finite and not negative. Use the semantics.npz of a run."
        )


def _require_names(path: Path, labels: np.ndarray, names: tuple[str, ...]) -> None:
    rows = fields(labels)
    last = int(rows["ids"][rows["weights"] > 0].max(initial=0))
    if not last < len(names) <= MAX_LABELS:
        raise DataError(
            f"{path} has {len(names)} names of labels, but must have {last + 1} to {MAX_LABELS}, "
            f"because its largest label index is {last}. Use the semantics.npz of a run."
        )
