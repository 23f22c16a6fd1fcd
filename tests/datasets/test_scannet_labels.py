from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ldo_service.datasets import SequenceOptions, open_sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry.sequence import TrueLabels

Writer = Callable[..., Path]
TABLE = "scannetv2-labels.combined.tsv"
ROWS = (
    "id\traw_category\tcategory\tnyu40id\tnyu40class",
    "1\twall\twall\t1\twall",
    "2\tchair\tchair\t5\tchair",
    "1191\tnewspaper\tnewspaper\t40\totherprop",
)
LABELS = np.full((32, 48), 1, np.uint16)
LABELS[10:20, 11:30], LABELS[0, 0] = 2, 1191
OBJECTS = np.where(LABELS == 2, 7, 0)


def with_labels(folder: Path, labels: str = "label-filt", instances: str = "instance-filt") -> Path:
    """Write labels of frame 0 at the size of the color image, and the table above the scene."""
    (folder.parent / TABLE).write_text("\n".join([*ROWS, ""]))
    for name, image in ((labels, LABELS), (instances, OBJECTS.astype(np.uint8))):
        (folder / name).mkdir()
        assert cv2.imwrite(str(folder / name / "0.png"), image)
    return folder


def labels_of(folder: Path, options: SequenceOptions | None = None) -> TrueLabels:
    labels = open_sequence(str(folder), options).true_labels()
    assert labels is not None
    return labels


@pytest.mark.parametrize("names", [("label-filt", "instance-filt"), ("label", "instance")])
def test_categories_become_nyu40_classes_on_the_color_grid(
    scannet_folder: Writer, names: tuple[str, str]
) -> None:
    folder = with_labels(scannet_folder([0]), *names)
    labels = labels_of(folder, SequenceOptions(register_depth=True))
    assert (labels.class_names[1], labels.class_names[5]) == ("wall", "chair")
    assert (len(labels.class_names), labels.class_names[0], labels.class_names[2]) == (41, "", "")
    found = labels.frame(0)
    expected = np.select([LABELS == 1, LABELS == 2], [1, 5], 40)
    np.testing.assert_array_equal(found.class_ids, expected)
    np.testing.assert_array_equal(found.instance_ids, OBJECTS)
    assert (found.class_ids.dtype, found.instance_ids.dtype) == (np.uint8, np.uint16)


def test_labels_get_the_pixels_of_depth_and_are_not_mixed(scannet_folder: Writer) -> None:
    """Depth pixel u is at 2 u + 0.5 in color; the tie goes to the pixel 2 u + 1."""
    found = labels_of(with_labels(scannet_folder([0]))).frame(0)
    np.testing.assert_array_equal(found.instance_ids, OBJECTS[1::2, 1::2])
    np.testing.assert_array_equal(found.class_ids, np.where(OBJECTS[1::2, 1::2] == 7, 5, 1))


def test_pixels_outside_the_color_view_have_no_label(
    scannet_folder: Writer, write_matrix: Callable[..., None]
) -> None:
    folder = with_labels(scannet_folder([0]))
    K = np.diag([80.0, 84.0, 1.0, 1.0])  # Twice the focal length: color sees the middle half.
    K[0, 2], K[1, 2] = 23.5, 15.5
    write_matrix(folder / "intrinsic/intrinsic_color.txt", K)
    class_ids = labels_of(folder).frame(0).class_ids
    assert np.all(class_ids[4:12, 6:18] > 0)
    class_ids[4:12, 6:18] = 0
    assert not class_ids.any()


def test_scene_without_label_images_has_no_labels(scannet_folder: Writer) -> None:
    assert open_sequence(str(scannet_folder([0]))).true_labels() is None


def test_missing_table_is_an_error_that_says_where_it_belongs(scannet_folder: Writer) -> None:
    folder = with_labels(scannet_folder([0]))
    (folder.parent / TABLE).rename(folder / TABLE)
    assert labels_of(folder).class_names[5] == "chair"
    (folder / TABLE).unlink()
    with pytest.raises(DataError, match=rf"Copy the file .* to {folder.parent / TABLE}"):
        open_sequence(str(folder)).true_labels()


@pytest.mark.parametrize(
    "text", ["id\tnyu40id\n1\t1\n", "id\tnyu40id\tnyu40class\n1\t300\tx\n", "a,b\n1,2\n", "id\n"]
)
def test_invalid_table_is_named(scannet_folder: Writer, text: str) -> None:
    folder = with_labels(scannet_folder([0]))
    (folder.parent / TABLE).write_text(text)
    with pytest.raises(DataError, match=TABLE):
        open_sequence(str(folder)).true_labels()


def test_missing_objects_and_missing_frames_are_errors(scannet_folder: Writer) -> None:
    folder = with_labels(scannet_folder([0, 1]))
    with pytest.raises(DataError, match=r"label-filt has no labels of frame 1"):
        labels_of(folder).frame(1)
    (folder / "instance-filt/0.png").unlink()
    (folder / "instance-filt").rmdir()
    with pytest.raises(DataError, match=r"_2d-instance-filt\.zip"):
        open_sequence(str(folder)).true_labels()


def test_labels_of_another_size_or_depth_are_errors(scannet_folder: Writer) -> None:
    folder = with_labels(scannet_folder([0]))
    cv2.imwrite(str(folder / "label-filt/0.png"), LABELS[:16])
    with pytest.raises(FrameError, match="labels are 48x16 pixels, but the color image has 48x32"):
        labels_of(folder).frame(0)
    cv2.imwrite(str(folder / "label-filt/0.png"), LABELS.astype(np.uint8))
    with pytest.raises(FrameError, match="expected one channel of 16 bits"):
        labels_of(folder).frame(0)
