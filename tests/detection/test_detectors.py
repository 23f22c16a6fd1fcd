"""Detectors: synthetic networks in three layouts, invalid files and real networks."""

import json
import os
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.detection.detectors import Detections, NetworkConfig, OnnxDetector
from ldo_service.detection.vocabulary import COCO, coco_class
from ldo_service.detection.yolo import STRIDES_PX, find_grid
from ldo_service.errors import ConfigError, ModelError

from .networks import COLORS, SQUARES, squares_image, squares_network

LAYOUTS = tuple(SQUARES)


@pytest.fixture(params=LAYOUTS)
def layout(request: pytest.FixtureRequest) -> str:
    return request.param


def open_detector(tmp_path: Path, layout: str, config: NetworkConfig | None = None, **fields):
    return OnnxDetector(squares_network(layout, **fields).write(tmp_path / "net.onnx"), config)


def named_boxes(detector: OnnxDetector, image: np.ndarray) -> list[tuple[str, list[float]]]:
    detections = detector.detect(image)
    names = [detector.labels[class_id] for class_id in detections.class_ids]
    return sorted(zip(names, detections.boxes_px.tolist(), strict=True))


def test_layout_is_recognized_and_boxes_match_squares(tmp_path, layout) -> None:
    detector = open_detector(tmp_path, layout)
    assert (detector.layout, detector.labels, detector.input_px) == (layout, COLORS, (128, 96))
    image = squares_image([("red", 16, 48, 16), ("blue", 112, 80, 16), ("red", 64, 0, 16)])
    assert named_boxes(detector, image) == [
        ("blue", [111.5, 79.5, 127.5, 95.5]),
        ("red", [15.5, 47.5, 31.5, 63.5]),
        ("red", [63.5, -0.5, 79.5, 15.5]),
    ]
    assert detector.detect(image).scores == pytest.approx(254 / 255, rel=1e-5)


def test_images_of_another_size_are_letterboxed(tmp_path, layout) -> None:
    """A cell of 16 px is 40 px of the image; its position depends on the letterbox."""
    detector = open_detector(tmp_path, layout)
    left = {"yolov5": 40, "yolov8": 40, "yolox": 80}[layout]  # 16 of 128 columns are padding.
    image = squares_image([("green", left, 40, 40)], width=240, height=240)
    ((name, box),) = named_boxes(detector, image)
    assert name == "green"
    assert box == pytest.approx([left - 0.5, 39.5, left + 39.5, 79.5])


def test_dynamic_input_size_uses_configured_size(tmp_path, layout) -> None:
    detector = open_detector(tmp_path, layout, NetworkConfig(input_px=(128, 96)), is_free=True)
    assert detector.input_px == (128, 96)
    assert len(detector.detect(squares_image([("red", 16, 48, 16)]))) == 1


def test_image_without_objects_gives_no_boxes(tmp_path, layout) -> None:
    detections = open_detector(tmp_path, layout).detect(np.full((96, 128, 3), 128, np.uint8))
    assert (detections.boxes_px.shape, len(detections)) == ((0, 4), 0)


def test_configured_score_and_box_limits_apply(tmp_path, layout) -> None:
    image = squares_image([("red", 16, 48, 16), ("red", 64, 48, 16), ("blue", 0, 0, 16)])
    image[48:64, 64:80] //= 4  # A dark square.
    assert len(open_detector(tmp_path, layout, NetworkConfig(score_min=0.2)).detect(image)) == 3
    assert len(open_detector(tmp_path, layout, NetworkConfig(score_min=0.3)).detect(image)) == 2
    (score,) = open_detector(tmp_path, layout, NetworkConfig(max_boxes=1)).detect(image).scores
    assert score > 0.9, "the most certain is kept"


def test_decoded_yolox_output_is_recognized(tmp_path) -> None:
    detector = open_detector(tmp_path, "yolox", is_decoded=True)
    assert named_boxes(detector, squares_image([("red", 16, 48, 16)])) == [
        ("red", [15.5, 47.5, 31.5, 63.5])
    ]


def test_repeated_detection_is_bitwise_equal(tmp_path, layout) -> None:
    image = np.random.default_rng(1).integers(0, 256, (100, 150, 3)).astype(np.uint8)
    config = NetworkConfig(score_min=0.0)
    one, other = (open_detector(tmp_path, layout, config).detect(image) for _ in range(2))
    assert len(one) == config.max_boxes
    for field in ("boxes_px", "scores", "class_ids"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field))


# --- names ----------------------------------------------------------------------------------------
def test_eighty_classes_without_names_are_coco_classes(tmp_path, layout) -> None:
    assert open_detector(tmp_path, layout, metadata=None, classes=80).names == COCO


def test_configured_names_override_names_of_the_file(tmp_path, layout) -> None:
    (tmp_path / "names.txt").write_text("Sofa\nTV-Screen\nglobe\n")
    config = NetworkConfig(names=str(tmp_path / "names.txt"))
    assert open_detector(tmp_path, layout, config).labels == ("couch", "tv", "globe")


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, "3 classes without names"),
        ("{0: 'a', 1: 'b'}", "3 classes, but the entry `names` of its metadata has 2"),
        ("{0: 'a', 1: 'b', 3: 'c'}", "Expected: a list of class names"),
        ("['a', 'b', 3]", "names that are not of 1 to 100 characters"),
        ("['a', 'b', '']", "names that are not of 1 to 100 characters"),
        ("['a', 'b', '_ -']", "names that are not of 1 to 100 characters"),
        ("__import__('os').getcwd()", "Expected: a list of class names"),
    ],
)
def test_invalid_class_names_in_metadata_raise(tmp_path, layout, metadata, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        open_detector(tmp_path, layout, metadata=metadata)


@pytest.mark.parametrize(
    ("text", "message"),
    [("a\nb\n", "list of names has 2"), ("a\n\nc\n", "line 2 of"), (None, "read")],
)
def test_invalid_names_file_raises_config_error(tmp_path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "names.txt").write_text(text)
    with pytest.raises(ConfigError, match=message):
        open_detector(tmp_path, "yolov8", NetworkConfig(names=str(tmp_path / "names.txt")))


# --- invalid networks and settings ----------------------------------------------------------------
@pytest.mark.parametrize("body", [b"", b"no network", b"\x08\x08" + bytes(100)])
def test_file_that_is_not_onnx_raises(tmp_path, body: bytes) -> None:
    (tmp_path / "net.onnx").write_bytes(body)
    with pytest.raises(ModelError, match=r"net\.onnx cannot be used .*no network in ONNX"):
        OnnxDetector(tmp_path / "net.onnx")


def test_truncated_file_raises(tmp_path) -> None:
    path = SQUARES["yolov5"].write(tmp_path / "net.onnx")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ModelError, match="cannot be used"):
        OnnxDetector(path)


def test_missing_file_raises(tmp_path) -> None:
    with pytest.raises(ModelError, match=r"absent\.onnx does not exist"):
        OnnxDetector(tmp_path / "absent.onnx")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"has_nan": True}, "NaN or infinity"),
        ({"has_logits": True}, "no probabilities"),
        ({"more_outputs": True}, "2 outputs. Expected: one"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_unsupported_output_raises_one_line_message(tmp_path, layout, fields, message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        open_detector(tmp_path, layout, **fields)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("layout", ["yolov5", "yolov8"])
def test_normalized_boxes_raise(tmp_path, layout: str) -> None:
    with pytest.raises(ModelError, match="export the network with boxes in pixels"):
        open_detector(tmp_path, layout, is_normalized=True, width=640, height=640)


def test_box_count_of_no_known_grid_raises(tmp_path, layout) -> None:
    with pytest.raises(ModelError, match=r"of no known layout. Expected: \[1, N, 5 \+ C\]"):
        open_detector(tmp_path, layout, width=120, height=88)


@pytest.mark.parametrize("configured", LAYOUTS)
def test_configured_layout_must_match_the_network(tmp_path, layout, configured: str) -> None:
    config = NetworkConfig(layout=configured)
    if configured == layout:
        assert open_detector(tmp_path, layout, config).layout == configured
    else:
        with pytest.raises(ModelError):
            open_detector(tmp_path, layout, config)


@pytest.mark.parametrize(
    "fields",
    [
        {"layout": "yolo"},
        {"score_min": 1.5},
        {"nms_iou": -0.1},
        {"max_boxes": 0},
        {"threads": 0},
        {"input_px": (0, 480)},
    ],
)
def test_invalid_settings_raise_config_error(fields) -> None:
    with pytest.raises(ConfigError):
        NetworkConfig(**fields)


@pytest.mark.parametrize("input_px", [(640, 640), (640, 448), (448, 256), (128, 64)])
def test_box_count_identifies_the_grid(input_px: tuple[int, int]) -> None:
    strides = [STRIDES_PX[first:end] for first, end in combinations(range(len(STRIDES_PX) + 1), 2)]
    cells = [sum(input_px[0] * input_px[1] // side**2 for side in subset) for subset in strides]
    assert len({*cells, *(3 * count for count in cells)}) == 2 * len(strides) == 30
    for subset, count in zip(strides, cells, strict=True):
        for boxes_per_cell in (1, 3):
            grid = find_grid(boxes_per_cell * count, input_px)
            assert grid is not None
            assert grid.boxes_per_cell == boxes_per_cell
            assert set(grid.strides_px.ravel()) == set(subset)


# --- devices --------------------------------------------------------------------------------------
def test_missing_device_is_replaced_by_the_cpu_with_a_warning(tmp_path, caplog) -> None:
    detector = open_detector(tmp_path, "yolov8", NetworkConfig(device="openvino"))
    assert detector.providers == ["CPUExecutionProvider"]
    (record,) = caplog.records
    assert "OpenVINOExecutionProvider is missing from the installed onnx" in record.getMessage()
    assert detector.metrics() == {"device_failed": 1, "on_gpu": 0}


def test_auto_without_a_gpu_is_the_cpu_without_a_warning(tmp_path, caplog) -> None:
    detector = open_detector(tmp_path, "yolov8", NetworkConfig(device="auto"))
    assert detector.providers == ["CPUExecutionProvider"]
    assert not caplog.records
    assert detector.metrics() == {"device_failed": 0, "on_gpu": 0}


# --- real networks --------------------------------------------------------------------------------
@pytest.fixture(params=["yolox_nano.onnx", "yolov5n_480x640_w16.onnx"])
def real_detector(request: pytest.FixtureRequest) -> OnnxDetector:
    folder = os.environ.get("LDO_WEIGHTS")
    if not folder:
        pytest.skip("set LDO_WEIGHTS to a folder with yolox_nano.onnx and yolov5n_480x640_w16.onnx")
    return OnnxDetector(Path(folder) / request.param)


def read_color(folder: Path, index: int) -> np.ndarray:
    return open_sequence(str(folder)).read(index).color


def labels_of(detector: OnnxDetector, detections: Detections) -> list[str]:
    return [detector.labels[class_id] for class_id in detections.class_ids]


def test_real_networks_detect_furniture_of_the_kitchen(
    data: Path, real_detector: OnnxDetector
) -> None:
    labels = labels_of(real_detector, real_detector.detect(read_color(data / "tum" / "kitchen", 0)))
    assert {"chair", "cup"} <= set(labels)
    assert "book" not in labels[:2]
    assert set(labels) <= {"chair", "cup", "dining table", "book", "laptop"}


def test_real_networks_match_ground_truth_of_the_apartment(
    data: Path, real_detector: OnnxDetector
) -> None:
    """Compare boxes that have a score of at least 0.5 to the true boxes of their class."""
    folder = data / "replica" / "apartment_floor1"
    detections = real_detector.detect(read_color(folder, 100))
    confident = detections.chosen(np.flatnonzero(detections.scores >= 0.5))
    truth = true_boxes(folder, 100)
    overlaps = [
        max(iou(box, true) for true in truth[label])
        for label, box in zip(labels_of(real_detector, confident), confident.boxes_px, strict=True)
    ]
    assert {"chair", "potted plant"} <= set(labels_of(real_detector, confident))
    assert np.mean(np.array(overlaps) > 0.5) >= 0.6, overlaps
    assert max(overlaps) > 0.8


def true_boxes(folder: Path, index: int) -> dict[str, list[np.ndarray]]:
    """Return the box of each instance in the frame, by COCO class."""
    names = {
        int(number): coco_class(entry["name"])
        for number, entry in json.loads((folder / "labels.json").read_text())["instances"].items()
    }
    instances = cv2.imread(str(folder / "instance" / f"{index:06d}.png"), cv2.IMREAD_UNCHANGED)
    boxes: dict[str, list[np.ndarray]] = {}
    for number in np.unique(instances):
        rows, columns = np.nonzero(instances == number)
        box = np.array([columns.min(), rows.min(), columns.max(), rows.max()])
        if name := names.get(int(number)):
            boxes.setdefault(name, []).append(box + np.array([-0.5, -0.5, 0.5, 0.5]))
    return boxes


def iou(a: np.ndarray, b: np.ndarray) -> float:
    sides = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    intersection = np.maximum(sides, 0).prod()
    return intersection / (np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]) - intersection)


def test_yolox_decoding_matches_plain_loops_and_opencv(
    data: Path, real_detector: OnnxDetector
) -> None:
    if real_detector.layout != "yolox":
        pytest.skip("the reference covers only the layout with encoded boxes")
    image = read_color(data / "tum" / "kitchen", 0)
    scale = 416 / 640
    canvas = np.full((416, 416, 3), 114, np.uint8)
    canvas[:312] = cv2.resize(image, (416, 312))
    session = onnxruntime.InferenceSession(
        str(Path(os.environ["LDO_WEIGHTS"]) / "yolox_nano.onnx"), providers=["CPUExecutionProvider"]
    )
    planes = canvas[..., ::-1].transpose(2, 0, 1)[None].astype(np.float32)
    rows = iter(session.run(None, {"images": planes})[0][0])
    boxes, scores, class_ids = [], [], []
    for stride in (8, 16, 32):
        for y, x in np.ndindex(416 // stride, 416 // stride):
            row = next(rows)
            center = (row[:2] + np.array([x, y])) * stride / scale
            sides = np.exp(row[2:4]) * stride / scale
            boxes.append([*(center - sides / 2), *sides])
            class_ids.append(int(row[5:].argmax()))
            scores.append(float(row[4] * row[5:].max()))
    kept = cv2.dnn.NMSBoxesBatched(boxes, scores, class_ids, 0.25, 0.45)  # type: ignore[call-overload]
    actual = real_detector.detect(image)
    assert actual.class_ids.tolist() == [class_ids[i] for i in kept]
    np.testing.assert_allclose(actual.scores, [scores[i] for i in kept], rtol=1e-5)
    expected = np.array([boxes[i] for i in kept])
    corners = np.hstack((expected[:, :2], expected[:, :2] + expected[:, 2:]))
    clipped = np.clip(corners, 0, [640, 480, 640, 480]) - 0.5
    np.testing.assert_allclose(actual.boxes_px, clipped, atol=1e-3)
