"""Detections for each keyframe, also without a usable network."""

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
def red_keyframe(keyframes: list[Keyframe]) -> Keyframe:
    """A keyframe with a red square."""
    return keyframe_of(keyframes[0], squares_image([("red", 16, 48, 16)]))


def detector(path: Path, **network) -> Detector:
    return Detector(DetectorConfig(model=str(path), network=NetworkConfig(**network)))


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return SQUARES["yolov8"].write(tmp_path / "squares.onnx")


def only_message(messages) -> DetectionBoxes:
    (message,) = messages
    return message


def test_detections_have_label_box_and_score(model: Path, red_keyframe: Keyframe) -> None:
    actor = detector(model)
    boxes = only_message(actor.handle(red_keyframe))
    assert (boxes.keyframe, boxes.stamp_ns) == (red_keyframe.keyframe, red_keyframe.stamp_ns)
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
        "device_failed": 0,
        "on_gpu": 0,
    }


def test_keyframe_without_objects_gives_empty_detections(model: Path, red_keyframe) -> None:
    boxes = only_message(detector(model).handle(keyframe_of(red_keyframe, squares_image([]))))
    assert boxes.detections == ()
    assert boxes.network, "a network was used"


def test_detections_do_not_depend_on_earlier_keyframes(
    model: Path, keyframes: list[Keyframe]
) -> None:
    one, other = detector(model, score_min=0.0), detector(model, score_min=0.0)
    list(other.handle(keyframes[1]))
    bodies = [encode(only_message(actor.handle(keyframes[0]))) for actor in (one, other, other)]
    assert len(set(bodies)) == 1
    assert b"label" in bodies[0]


def test_without_model_keyframes_get_empty_detections_without_network(
    red_keyframe: Keyframe,
) -> None:
    actor = Detector()
    boxes = only_message(actor.handle(red_keyframe))
    assert (boxes.keyframe, boxes.detections, boxes.network) == (red_keyframe.keyframe, (), "")
    assert (actor.metrics()["networks"], actor.metrics()["networks_missing"]) == (0, 0)


@pytest.mark.parametrize("body", [b"garbage", None])
def test_unusable_model_is_logged_once_and_gives_empty_detections(
    tmp_path: Path, red_keyframe: Keyframe, caplog, body: bytes | None
) -> None:
    path = tmp_path / "net.onnx"
    if body is not None:
        path.write_bytes(body)
    actor = detector(path)
    for _ in range(3):
        assert only_message(actor.handle(red_keyframe)).network == ""
    (record,) = caplog.records
    assert record.levelno == logging.ERROR
    assert str(path) in record.getMessage()
    assert actor.metrics()["networks_missing"] == 1


def test_model_without_class_names_is_not_assumed_to_be_coco(
    tmp_path: Path, red_keyframe: Keyframe, caplog
) -> None:
    actor = detector(squares_network("yolox", metadata=None).write(tmp_path / "net.onnx"))
    assert only_message(actor.handle(red_keyframe)).detections == ()
    assert "3 classes without names" in caplog.text


def test_failed_inferences_are_counted_and_logged_once_per_episode(
    tmp_path: Path, red_keyframe: Keyframe, caplog
) -> None:
    actor = detector(squares_network("yolov8", fails_on_white=True).write(tmp_path / "net.onnx"))
    white = keyframe_of(red_keyframe, np.full((96, 128, 3), 255, np.uint8))
    answers = [
        only_message(actor.handle(frame))
        for frame in (red_keyframe, white, white, red_keyframe, white)
    ]
    assert [bool(answer.network) for answer in answers] == [True, False, False, True, False]
    assert [len(answer.detections) for answer in answers] == [1, 0, 0, 1, 0]
    assert actor.metrics()["inferences_failed"] == 3
    assert len(caplog.records) == 2, "one per episode"
    assert "NaN" in caplog.text


def test_unusable_model_is_refused_before_an_offline_run(tmp_path: Path, model: Path) -> None:
    require_detector(DetectorConfig())
    require_detector(DetectorConfig(model=str(model)))
    with pytest.raises(ConfigError, match="nor an ONNX file, nor registered"):
        require_detector(DetectorConfig(model="nothing"))
    (tmp_path / "garbage.onnx").write_text("garbage")
    with pytest.raises(ModelError, match="no network in ONNX"):
        require_detector(DetectorConfig(model=str(tmp_path / "garbage.onnx")))
