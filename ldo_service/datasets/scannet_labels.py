"""Ground-truth labels of a ScanNet scene, as NYU40 classes.

    label-filt/*.png               16 bits per pixel: ScanNet's category id; named by frame number
    instance-filt/*.png            8 or 16 bits per pixel: the object; named by frame number
    scannetv2-labels.combined.tsv  columns id, nyu40id and nyu40class; in this folder or above it

The images have the size of the color images. The unfiltered folders label/ and instance/ are used
if the filtered ones are missing.
"""

import csv
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry.registration import resample_labels
from ldo_service.geometry.sequence import FrameLabels, TrueLabels

from .files import numbered
from .images import read_labels
from .rig import Rig

TABLE = "scannetv2-labels.combined.tsv"
FOLDERS_ABOVE = 3  # The table is searched in the scene's folder and this many folders above it.
MAX_CLASS = 255  # Largest class id in a label image.
RAW_IDS = 1 << 16  # Number of values of a 16-bit image.


@dataclass(frozen=True, eq=False, slots=True)
class CategoryTable:
    """NYU40 classes of ScanNet's categories.

    Attributes:
        class_ids: NYU40 class by category id, [65536] uint8; 0 for a category without a class.
        class_names: Names of the classes, by class id; empty for a class without a name.
    """

    class_ids: np.ndarray
    class_names: tuple[str, ...]


class ScanNetLabels:
    """Reader of the ground-truth labels of a ScanNet scene."""

    def __init__(self, folder: Path, numbers: np.ndarray, rig: Rig, is_registering: bool) -> None:
        """Open the labels of a folder.

        Args:
            folder: The folder of the scene.
            numbers: Numbers of the frames, [N].
            rig: Cameras of the scene.
            is_registering: True if the frames have the pixels of the color camera, False if they
                have those of the depth camera.
        """
        self._folder, self._numbers, self._rig = folder, numbers, rig
        self._is_registering = is_registering

    def read(self) -> TrueLabels | None:
        """Return the labels, or None if the scene has no label images.

        Raises:
            DataError: The table of categories is missing or invalid, or the objects are missing.
        """
        if self._labels is None:
            return None
        if self._instances is None:
            raise DataError(
                f"{self._folder} has {self._labels.name}/, but no folder with the objects of the "
                "pixels. Extract the scene's _2d-instance-filt.zip into this folder."
            )
        return TrueLabels(self._table.class_names, self.frame)

    def frame(self, index: int) -> FrameLabels:
        """Read the labels of a frame, on the pixels of `Sequence.read`.

        Raises:
            DataError: The frame has no labels.
            FrameError: An image cannot be read or has another size than the color images.
        """
        labels = self._read(self._label_files, self._labels, index, (np.uint16,))
        instances = self._read(self._instance_files, self._instances, index, (np.uint8, np.uint16))
        ids = instances.astype(np.uint16)
        return FrameLabels(self._on_grid(self._table.class_ids[labels]), self._on_grid(ids))

    def _read(
        self,
        files: dict[int, Path],
        folder: Path | None,
        index: int,
        dtypes: tuple[type[np.unsignedinteger], ...],
    ) -> np.ndarray:
        number = int(self._numbers[index])
        if number not in files:
            raise DataError(
                f"{folder} has no labels of frame {number}: expected {number}.png. Extract the "
                "scene's label images again."
            )
        return read_labels(files[number], *dtypes)

    def _on_grid(self, labels: np.ndarray) -> np.ndarray:
        """Bring labels of the color image to the pixels of the frames."""
        rig = self._rig
        target = rig.color_camera if self._is_registering else rig.depth_camera
        return resample_labels(labels, rig.color_camera, target)

    @property
    def _labels(self) -> Path | None:
        return self._first("label-filt", "label")

    @property
    def _instances(self) -> Path | None:
        return self._first("instance-filt", "instance")

    def _first(self, *names: str) -> Path | None:
        folders = (self._folder / name for name in names)
        return next((folder for folder in folders if folder.is_dir()), None)

    @cached_property
    def _label_files(self) -> dict[int, Path]:
        return {} if self._labels is None else numbered(self._labels, r"(\d+)\.png")

    @cached_property
    def _instance_files(self) -> dict[int, Path]:
        return {} if self._instances is None else numbered(self._instances, r"(\d+)\.png")

    @cached_property
    def _table(self) -> CategoryTable:
        return read_categories(find_table(self._folder))


def find_table(folder: Path) -> Path:
    """Return the table of categories in a folder or in one of the folders above it.

    Raises:
        DataError: The table does not exist.
    """
    folder = folder.resolve()
    folders = (folder, *folder.parents)[: 1 + FOLDERS_ABOVE]
    found = next((place / TABLE for place in folders if (place / TABLE).is_file()), None)
    if found is None:
        raise DataError(
            f"{folder} has label images, but {TABLE} is missing, which names their categories. "
            f"Copy the file of the data set to {folder.parent / TABLE}."
        )
    return found


def read_categories(path: Path) -> CategoryTable:
    """Read a table of categories: text with tabs and the columns id, nyu40id and nyu40class.

    Raises:
        DataError: The file cannot be read, or a column is missing or invalid.
    """
    class_ids, names = np.zeros(RAW_IDS, np.uint8), dict[int, str]()
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file, delimiter="\t"):
                category, class_id = int(row["id"]), int(row["nyu40id"])
                if not (0 <= category < RAW_IDS and 0 <= class_id <= MAX_CLASS):
                    raise ValueError(f"id {category} and nyu40id {class_id} are out of range")
                class_ids[category] = class_id
                names[class_id] = row["nyu40class"].strip()
    except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as error:
        raise DataError(
            f"{path} is no table of ScanNet's categories: {error!r}. Expected tabs between the "
            "columns id, nyu40id and nyu40class among others. Copy the file of the data set again."
        ) from error
    if not names:
        raise DataError(f"{path} has no categories. Copy the file of the data set again.")
    names[0] = ""  # Class 0 has the pixels without a label.
    return CategoryTable(class_ids, tuple(names.get(k, "") for k in range(max(names) + 1)))
