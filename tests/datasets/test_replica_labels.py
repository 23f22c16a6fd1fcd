import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from ldo_service.datasets import Cached, open_sequence
from ldo_service.errors import DataError, FrameError

Writer = Callable[..., Path]


def with_labels(folder: Path, numbers: list[int]) -> Path:
    """Write labels: class k and object 300 + k cover frame k."""
    for kind, dtype, start in (("semantic_class", np.uint8, 0), ("instance", np.uint16, 300)):
        (folder / kind).mkdir()
        for k in numbers:
            image = np.full((12, 16), start + k, dtype)
            cv2.imwrite(str(folder / kind / f"{k:06d}.png"), image)
    names = {"0": "undefined", "1": "sofa", "5": "indoor-plant"}
    (folder / "labels.json").write_text(json.dumps({"classes": names}))
    return folder


def test_labels_belong_to_the_numbers_of_frames(replica_folder: Writer) -> None:
    folder = with_labels(replica_folder([0, 1, 5]), [0, 1, 5])
    labels = Cached(open_sequence(str(folder))).true_labels()
    assert labels is not None
    assert labels.class_names == ("undefined", "sofa", "", "", "", "indoor-plant")
    last = labels.frame(2)
    assert (last.class_ids.dtype, last.instance_ids.dtype) == (np.uint8, np.uint16)
    assert (np.unique(last.class_ids), np.unique(last.instance_ids)) == (5, 305)


def test_sequence_without_labels_json_has_no_labels(replica_folder: Writer) -> None:
    assert open_sequence(str(replica_folder([0]))).true_labels() is None


def test_a_frame_without_labels_is_named(replica_folder: Writer) -> None:
    labels = open_sequence(str(with_labels(replica_folder([0, 1]), [0]))).true_labels()
    assert labels is not None
    with pytest.raises(DataError, match="no labels of frame 1"):
        labels.frame(1)


def test_image_of_another_type_or_a_truncated_one_is_named(replica_folder: Writer) -> None:
    folder = with_labels(replica_folder([0, 1]), [0, 1])
    labels = open_sequence(str(folder)).true_labels()
    assert labels is not None
    cv2.imwrite(str(folder / "instance/000000.png"), np.zeros((12, 16), np.uint8))
    with pytest.raises(FrameError, match=r"instance/000000.png.*16 bits"):
        labels.frame(0)
    path = folder / "semantic_class/000001.png"
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(FrameError, match=r"semantic_class/000001.png is truncated"):
        labels.frame(1)


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"classes": ["a"]}', '{"classes": {"x": "a"}}', '{"classes": {}}',
             '{"classes": {"256": "a"}}', '{"classes": {"-1": "a"}}']
)  # fmt: skip
def test_invalid_labels_json_is_a_data_error(replica_folder: Writer, text: str) -> None:
    folder = replica_folder([0])
    (folder / "labels.json").write_text(text)
    with pytest.raises(DataError, match=r"labels\.json"):
        open_sequence(str(folder)).true_labels()
