"""Boxes for each keyframe, and what becomes of a network that cannot be used."""

import logging
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.actors.detector import Detector, DetectorConfig, require_detector
from ldo_service.detection.detectors import NetworkConfig
from ldo_service.errors import ConfigError, ModelError
from ldo_service.schemas import Array, CameraModel, DetectionBoxes, Keyframe, encode
from tests.detection.networks import SQUARES, squares_image, squares_network

SIZE = 128, 96


def keyframe_of(keyframe: Keyframe, image: np.ndarray, number: int = 4) -> Keyframe:
    height, width = image.shape[:2]
    return msgspec.structs.replace(
        keyframe,
        keyframe=number,
        reference=None,
        window_measurements=(),
        camera=CameraModel(width=width, height=height, fx=100, fy=100, cx=64, cy=48),
        color=Array.of(image),
        depth_m=Array.of(np.ones((height, width), np.float32)),
    )


@pytest.fixture
def red(keyframes: list[Keyframe]) -> Keyframe:
    """A keyframe that shows a red square."""
    return keyframe_of(keyframes[0], squares_image([("red", 16, 48, 16)]))


def detector(path: Path, **network) -> Detector:
    return Detector(DetectorConfig(model=str(path), network=NetworkConfig(**network)))


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return SQUARES["yolov8"].write(tmp_path / "squares.onnx")


def only(messages) -> DetectionBoxes:
    (message,) = messages
    return message


def test_a_keyframe_has_its_boxes_by_name(model: Path, red: Keyframe) -> None:
    actor = detector(model)
    boxes = only(actor.handle(red))
    assert (boxes.keyframe, boxes.stamp_ns) == (red.keyframe, red.stamp_ns)
    assert (boxes.width, boxes.height) == SIZE
    (found,) = boxes.detections
    assert (found.label, found.box_px) == ("red", (15.5, 47.5, 31.5, 63.5))
    assert found.score == pytest.approx(254 / 255)
    assert boxes.network.startswith("squares ")
    assert actor.metrics() == {
        "networks": 1,
        "networks_missing": 0,
        "inferences_failed": 0,
        "boxes": 1,
    }


def test_a_keyframe_without_objects_has_a_message_without_boxes(model: Path, red) -> None:
    boxes = only(detector(model).handle(keyframe_of(red, squares_image([]))))
    assert boxes.detections == ()
    assert boxes.network, "somebody looked"


def test_real_sized_keyframes_give_the_same_bytes_from_any_successor(
    model: Path, keyframes: list[Keyframe]
) -> None:
    one, other = detector(model, score_min=0.0), detector(model, score_min=0.0)
    list(other.handle(keyframes[1]))
    bodies = [encode(only(actor.handle(keyframes[0]))) for actor in (one, other, other)]
    assert len(set(bodies)) == 1
    assert b"label" in bodies[0]


def test_without_a_model_every_keyframe_is_answered_and_nobody_looked(red: Keyframe) -> None:
    actor = Detector()
    boxes = only(actor.handle(red))
    assert (boxes.keyframe, boxes.detections, boxes.network) == (red.keyframe, (), "")
    assert (actor.metrics()["networks"], actor.metrics()["networks_missing"]) == (0, 0)


@pytest.mark.parametrize("body", [b"garbage", None])
def test_a_model_that_cannot_be_used_is_said_once_and_the_service_goes_on(
    tmp_path: Path, red: Keyframe, caplog, body: bytes | None
) -> None:
    path = tmp_path / "net.onnx"
    if body is not None:
        path.write_bytes(body)
    actor = detector(path)
    for _ in range(3):
        assert only(actor.handle(red)).network == ""
    (record,) = caplog.records
    assert record.levelno == logging.ERROR
    assert str(path) in record.getMessage()
    assert actor.metrics()["networks_missing"] == 1


def test_a_model_of_other_classes_is_not_taken_for_one_of_coco(
    tmp_path: Path, red: Keyframe, caplog
) -> None:
    actor = detector(squares_network("yolox", metadata=None).write(tmp_path / "net.onnx"))
    assert only(actor.handle(red)).detections == ()
    assert "3 classes without names" in caplog.text


def test_a_network_that_fails_is_counted_and_warned_about_once(
    tmp_path: Path, red: Keyframe, caplog
) -> None:
    actor = detector(squares_network("yolov8", fails_on_white=True).write(tmp_path / "net.onnx"))
    white = keyframe_of(red, np.full((96, 128, 3), 255, np.uint8))
    answers = [only(actor.handle(frame)) for frame in (red, white, white, red, white)]
    assert [bool(answer.network) for answer in answers] == [True, False, False, True, False]
    assert [len(answer.detections) for answer in answers] == [1, 0, 0, 1, 0]
    assert actor.metrics()["inferences_failed"] == 3
    assert len(caplog.records) == 2, "once an episode"
    assert "NaN" in caplog.text


def test_a_run_over_a_file_is_told_before_it_begins(tmp_path: Path, model: Path) -> None:
    require_detector(DetectorConfig())
    require_detector(DetectorConfig(model=str(model)))
    with pytest.raises(ConfigError, match="nor an ONNX file, nor registered"):
        require_detector(DetectorConfig(model="nothing"))
    (tmp_path / "garbage.onnx").write_text("garbage")
    with pytest.raises(ModelError, match="no network in ONNX"):
        require_detector(DetectorConfig(model=str(tmp_path / "garbage.onnx")))
