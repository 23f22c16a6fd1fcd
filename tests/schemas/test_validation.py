"""Tests of message validation, when built and when received."""

from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest

from ldo_service.schemas import (
    Array,
    CameraModel,
    CameraRgbd,
    Detection,
    DetectionBoxes,
    FrameRgbd,
    Gaussians,
    GraphCorrection,
    Image,
    Keyframe,
    LoopClosure,
    MapDelta,
    MapObjects,
    MapSnapshot,
    Message,
    Pose,
    decode,
    encode,
)

from .examples import CAMERA, EXAMPLES

NAN, INF = float("nan"), float("inf")


def array(values: Any, dtype: Any) -> Array:
    return Array.of(np.array(values, dtype))


def image(encoding: Any = "rgb8", width: int = 2, height: int = 1, data: bytes = bytes(6)) -> Image:
    return Image(encoding=encoding, width=width, height=height, data=memoryview(data))


def changed(name: str, **fields: Any) -> Message:
    return msgspec.structs.replace(EXAMPLES[name], **fields)


def received(message: Message, **fields: Any) -> Message:
    """Return the message decoded after its encoded fields were replaced."""
    body = msgpack.packb({**msgpack.unpackb(encode(message)), **fields})
    return decode(body, type(message))


@pytest.mark.parametrize("name", EXAMPLES)
def test_negative_stamp_is_rejected(name: str) -> None:
    with pytest.raises(ValueError, match="stamp_ns is -1"):
        changed(name, stamp_ns=-1)
    with pytest.raises(msgspec.ValidationError, match="stamp_ns is -1"):
        received(EXAMPLES[name], stamp_ns=-1)
    with pytest.raises(msgspec.ValidationError, match="stamp_ns"):
        received(EXAMPLES[name], stamp_ns=2**63)


@pytest.mark.parametrize(
    ("translation", "quaternion", "error"),
    [
        ((NAN, 0, 0), (1, 0, 0, 0), "NaN"),
        ((0, INF, 0), (1, 0, 0, 0), "infinity"),
        ((0, 0, 0), (1, 0, NAN, 0), "NaN"),
        ((0, 0, -1.1e8), (1, 0, 0, 0), "within"),
        ((0, 0, 0), (0, 0, 0, 0), "norm 0"),
        ((0, 0, 0), (1, 0.1, 0, 0), "norm 1.00"),
        ((0, 0, 0), (1e200, 0, 0, 0), "norm inf"),
    ],
)
def test_invalid_pose_is_rejected(translation: Any, quaternion: Any, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        Pose(translation, quaternion)
    with pytest.raises(msgspec.ValidationError, match=error):
        received(
            EXAMPLES["tracked_pose"],
            T_map_odom={"translation": translation, "quaternion": quaternion},
        )


def test_quaternion_normalized_in_float32_is_accepted() -> None:
    q = np.array([0.1, 0.7, -0.3, 0.2], np.float32)
    q /= np.linalg.norm(q)
    assert Pose((0, 0, 0), tuple(q.tolist())).quaternion[0] > 0


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"width": 0}, "image size"),
        ({"height": -2}, "image size"),
        ({"width": 1 << 20, "height": 1 << 20}, "image size"),
        ({"fx": 0.0}, "focal"),
        ({"fy": -1.0}, "focal"),
        ({"cx": NAN}, "NaN"),
        ({"fx": INF}, "infinity"),
        ({"distortion": (0.1,)}, "distortion"),
        ({"distortion": (0.1, 0.1, NAN, 0.1)}, "NaN"),
    ],
)
def test_invalid_intrinsics_are_rejected(fields: dict[str, Any], error: str) -> None:
    with pytest.raises(ValueError, match=error):
        msgspec.structs.replace(CAMERA, **fields)


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"shape": [2, 2]}, "needs 16 bytes, has 24"),
        ({"shape": [3, 4]}, "needs 48 bytes, has 24"),
        ({"shape": [1 << 31, 1 << 31, 4]}, "bytes"),
        ({"shape": [-2, -3]}, "impossible"),
        ({"shape": [0, 1 << 62]}, "impossible"),
        ({"shape": [1] * 40}, "impossible"),
        ({"dtype": "f8"}, "needs 48 bytes"),
        ({"dtype": "O8"}, "dtype"),
        ({"data": b""}, "has 0"),
    ],
)
def test_array_with_a_buffer_of_the_wrong_size_is_rejected(
    fields: dict[str, Any], error: str
) -> None:
    depth = {**msgpack.unpackb(encode(EXAMPLES["frame_rgbd"]))["depth_m"], **fields}
    with pytest.raises(msgspec.ValidationError, match=error):
        received(EXAMPLES["frame_rgbd"], depth_m=depth)


@pytest.mark.parametrize("dtype", [bool, np.float16, np.uint64, object, "U3"])
def test_array_of_an_unsupported_type_is_rejected(dtype: Any) -> None:
    with pytest.raises(ValueError, match="are not supported"):
        Array.of(np.zeros(2, dtype))


def test_big_endian_transposed_array_keeps_its_values() -> None:
    values = np.arange(6, dtype=">f4").reshape(2, 3).T
    np.testing.assert_array_equal(Array.of(values).numpy(), values)


@pytest.mark.parametrize("name", ["frame_rgbd", "keyframe"])
@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"depth_m": array([[1.0, 2, 3]], np.float32)}, "must be f4"),
        ({"depth_m": array(np.zeros((2, 3)), np.float64)}, "must be f4"),
        ({"depth_m": array([[0, 0, 0], [0, NAN, 0]], np.float32)}, "finite"),
        ({"depth_m": array([[0, 0, 0], [0, INF, 0]], np.float32)}, "finite"),
        ({"depth_m": array([[0, 0, 0], [0, -1, 0]], np.float32)}, "at least 0"),
        ({"color": array(np.zeros((2, 3, 4)), np.uint8)}, "must be u1"),
        ({"color": array(np.zeros((3, 2, 3)), np.uint8)}, "must be u1"),
        ({"camera": msgspec.structs.replace(CAMERA, distortion=(0.1, 0, 0, 0))}, "distortion"),
        ({"frame": -1}, "frame is -1"),
    ],
)
def test_frame_that_contradicts_its_camera_is_rejected(
    name: str, fields: dict[str, Any], error: str
) -> None:
    with pytest.raises(ValueError, match=error):
        changed(name, **fields)


@pytest.mark.parametrize("reference", [4, 5, -1])
def test_keyframe_without_an_older_reference_is_rejected(reference: int) -> None:
    with pytest.raises(ValueError, match="must be an older keyframe"):
        changed("keyframe", reference=reference)


@pytest.mark.parametrize("information", [(1.0,) * 35, (*(1.0,) * 35, NAN)])
def test_matrix_of_the_wrong_size_or_with_nan_is_rejected(information: Any) -> None:
    with pytest.raises(ValueError, match="information"):
        changed("keyframe", information=information)
    with pytest.raises(ValueError, match="covariance"):
        changed("tracked_pose", covariance=information)


@pytest.mark.parametrize(
    "make",
    [
        lambda: image(data=bytes(5)),
        lambda: image("z16", data=bytes(3)),
        lambda: image("f32", data=bytes(9)),
        lambda: image("jpeg", data=b""),
        lambda: image(width=0, data=b""),
        lambda: image(width=1 << 20, height=1 << 20),
    ],
)
def test_image_with_bytes_that_do_not_fit_its_size_is_rejected(make: Any) -> None:
    with pytest.raises(ValueError, match="image"):
        make()


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"depth_scale": 0.0}, "depth_scale"),
        ({"depth_scale": NAN}, "depth_scale"),
        ({"color": image("z16", data=bytes(4))}, "color cannot"),
        ({"depth": image("jpeg", data=b"x")}, "depth cannot"),
        ({"depth": image("z16", width=1, data=bytes(2))}, "registered"),
        ({"color": image(width=1, data=bytes(3))}, "differ in size"),
    ],
)
def test_inconsistent_color_and_depth_images_are_rejected(
    fields: dict[str, Any], error: str
) -> None:
    with pytest.raises(ValueError, match=error):
        changed("camera_rgbd", **fields)


IDENTITIES = [[0, 0, 0, 1, 0, 0, 0], [1, 0, 0, 1, 0, 0, 0]]


@pytest.mark.parametrize(
    ("name", "fields", "error"),
    [
        ("camera_color", {"frame": -1}, "frame is -1"),
        ("camera_color", {"image": image("rgb8", 2, 1, bytes(6))}, "differ in size"),
        ("camera_color", {"image": image("z16", 3, 2, bytes(12))}, "color cannot"),
        ("camera_depth", {"frame": -1}, "frame is -1"),
        ("camera_depth", {"depth_scale": 0.0}, "depth_scale"),
        ("camera_depth", {"depth_scale": INF}, "depth_scale"),
        ("camera_depth", {"image": image("z16", 1, 1, bytes(2))}, "differ in size"),
        ("camera_depth", {"image": image("rgb8", 2, 1, bytes(6))}, "depth cannot"),
    ],
)
def test_inconsistent_color_or_depth_message_is_rejected(
    name: str, fields: dict[str, Any], error: str
) -> None:
    with pytest.raises(ValueError, match=error):
        changed(name, **fields)


@pytest.mark.parametrize(
    ("keyframes", "poses", "error"),
    [
        ([4, 0], IDENTITIES, "ascending"),
        ([4, 4], IDENTITIES, "ascending"),
        ([-1, 4], IDENTITIES, "at least 0"),
        ([-(2**63), 2**63 - 1], IDENTITIES, "at least 0"),
        ([0, 4, 5], IDENTITIES, "T_map_keyframe"),
        ([0], [[0, 0, 0, 1, 1, 0, 0]], "unit norm"),
        ([0], [[0, 0, 0, 1e200, 0, 0, 0]], "unit norm"),
        ([0], [[NAN, 0, 0, 1, 0, 0, 0]], "NaN"),
    ],
)
def test_correction_out_of_order_or_with_invalid_poses_is_rejected(
    keyframes: list[int], poses: Any, error: str
) -> None:
    with pytest.raises(ValueError, match=error):
        GraphCorrection(
            stamp_ns=0,
            graph_version=1,
            keyframes=array(keyframes, np.int64),
            T_map_keyframe=array(poses, np.float64),
        )


def test_correction_without_keyframes_is_accepted() -> None:
    empty = GraphCorrection(
        stamp_ns=0,
        graph_version=0,
        keyframes=array([], np.int64),
        T_map_keyframe=Array.of(np.zeros((0, 7))),
    )
    assert decode(encode(empty), GraphCorrection) == empty


@pytest.mark.parametrize(
    ("ids", "params", "anchors", "error"),
    [
        ([2, 1], np.zeros((2, 16)), [0, 0], "ascending"),
        ([1, 2], np.zeros((3, 16)), [0, 0], "params"),
        ([1, 2], np.zeros((2, 15)), [0, 0], "params"),
        ([1, 2], np.full((2, 16), NAN), [0, 0], "NaN"),
        ([1, 2], np.zeros((2, 16)), [0], "anchors"),
    ],
)
def test_gaussians_with_inconsistent_arrays_are_rejected(
    ids: Any, params: Any, anchors: Any, error: str
) -> None:
    with pytest.raises(ValueError, match=error):
        Gaussians(
            ids=array(ids, np.int64),
            params=array(params, np.float32),
            anchors=array(anchors, np.int32),
        )


def label_rows(count: int, width: int = 32, weight: float = 0.5) -> Array:
    rows = np.zeros((count, width), np.uint8)
    rows[:, :4] = np.array([weight], "<f4").view(np.uint8)
    return Array.of(rows)


@pytest.mark.parametrize(
    ("labels", "error"),
    [
        (label_rows(1), "labels is"),
        (label_rows(2, width=31), "labels is"),
        (label_rows(2, weight=NAN), "NaN"),
        (label_rows(2, weight=-0.5), "negative"),
    ],
)
def test_invalid_label_rows_are_rejected(labels: Array, error: str) -> None:
    arrays = {"ids": array([1, 2], np.int64), "params": array(np.zeros((2, 16)), np.float32)}
    with pytest.raises(ValueError, match=error):
        Gaussians(**arrays, anchors=array([0, 0], np.int32), labels=labels)


@pytest.mark.parametrize(
    ("names", "error"), [(("a",) * 257, "257 label_names"), (("a" * 101,), "101 characters")]
)
def test_too_many_or_too_long_label_names_are_rejected(names: tuple[str, ...], error: str) -> None:
    for example in ("map_delta", "map_snapshot"):
        with pytest.raises(ValueError, match=error):
            changed(example, label_names=names)


@pytest.mark.parametrize("since", [5, 6, -1])
def test_map_delta_to_an_older_version_is_rejected(since: int) -> None:
    with pytest.raises(ValueError, match="must be larger than its base_version"):
        changed("map_delta", base_version=since)


@pytest.mark.parametrize(("part", "parts"), [(2, 2), (-1, 2), (0, 0)])
def test_snapshot_part_outside_its_parts_is_rejected(part: int, parts: int) -> None:
    with pytest.raises(ValueError, match="0 <= part < parts"):
        changed("map_snapshot", part=part, parts=parts)


def test_health_message_with_nan_is_rejected() -> None:
    with pytest.raises(ValueError, match="NaN"):
        changed("health", metrics={"loss": NAN})


def test_received_messages_are_validated_too() -> None:
    for name, kind in [
        ("camera_rgbd", CameraRgbd),
        ("keyframe", Keyframe),
        ("frame_rgbd", FrameRgbd),
    ]:
        with pytest.raises(msgspec.ValidationError, match="frame is -1"):
            received(EXAMPLES[name], frame=-1)
        assert isinstance(EXAMPLES[name], kind)
    with pytest.raises(msgspec.ValidationError, match="must be larger than its base_version"):
        received(EXAMPLES["map_delta"], base_version=5)
    with pytest.raises(msgspec.ValidationError, match="0 <= part < parts"):
        received(EXAMPLES["map_snapshot"], part=2)
    assert isinstance(EXAMPLES["map_delta"], MapDelta)
    assert isinstance(EXAMPLES["map_snapshot"], MapSnapshot)


def test_camera_with_an_opencv_distortion_model_is_accepted() -> None:
    for count in (4, 5, 8):
        camera = CameraModel(width=3, height=2, fx=1, fy=1, cx=0, cy=0, distortion=(0.1,) * count)
        assert len(camera.distortion) == count


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"label": ""}, "0 characters"),
        ({"label": "x" * 101}, "101 characters"),
        ({"score": 1.01}, "within 0..1"),
        ({"score": NAN}, "NaN"),
        ({"box_px": (0.0, 0.0, INF, 1.0)}, "infinity"),
        ({"box_px": (1.0, 0.0, 1.0, 1.0)}, "empty"),
        ({"box_px": (0.0, 1.0, 1.0, 0.5)}, "empty"),
    ],
)
def test_invalid_detection_is_rejected(fields: dict, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        Detection(**{"label": "cup", "score": 0.5, "box_px": (0.0, 0.0, 1.0, 1.0), **fields})


@pytest.mark.parametrize(
    "box_px", [(-0.6, 0, 1, 1), (0, -0.6, 1, 1), (0, 0, 2.6, 1), (0, 0, 1, 1.6)]
)
def test_box_outside_the_image_is_rejected(box_px: tuple[float, ...]) -> None:
    full_image = (-0.5, -0.5, 2.5, 1.5)
    changed("detection_boxes", detections=(Detection(label="cup", score=1, box_px=full_image),))
    outside = Detection(label="cup", score=1, box_px=box_px)
    with pytest.raises(ValueError, match="leaves the image of 3x2"):
        changed("detection_boxes", detections=(outside,))


def test_boxes_without_the_name_of_a_network_are_rejected() -> None:
    with pytest.raises(ValueError, match="`network` must name the network"):
        changed("detection_boxes", network="")
    without_network = changed("detection_boxes", network="", detections=())
    assert isinstance(without_network, DetectionBoxes)


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"object": -1}, "object is -1"),
        ({"keyframe": -1}, "keyframe is -1"),
        ({"box_px": (2.0, 0.0, 1.0, 1.0)}, "inverted"),
        ({"box_px": (NAN, 0.0, 1.0, 1.0)}, "NaN"),
        ({"entropy": NAN}, "entropy"),
        ({"entropy": -0.1}, "entropy"),
        ({"distribution": ()}, "has 0 classes"),
        ({"distribution": (("cup", 0.7), ("cup", 0.3))}, "twice"),
        ({"distribution": (("cup", 0.7), ("vase", 0.5))}, "more than 1"),
        ({"distribution": (("cup", -0.1),)}, "negative"),
        ({"distribution": (("cup", INF),)}, "infinity"),
        ({"distribution": (("", 0.5),)}, "characters"),
    ],
)
def test_invalid_object_observation_is_rejected(fields: dict, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        changed("object_observation", **fields)


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"id": -1}, "id is -1"),
        ({"observation_count": -1}, "observation_count is -1"),
        ({"name": ""}, "0 characters"),
        ({"confidence": 1.5}, "within 0..1"),
        ({"centroid": (0.0, NAN, 0.0)}, "NaN"),
        ({"covariance": (1.0,) * 6}, "9 numbers"),
        ({"covariance": (-1.0, *(0.0,) * 8)}, "9 numbers"),
        ({"size": (1.0, -1.0, 1.0)}, "negative"),
    ],
)
def test_invalid_object_is_rejected(fields: dict, error: str) -> None:
    message = EXAMPLES["map_objects"]
    assert isinstance(message, MapObjects)
    with pytest.raises(ValueError, match=error):
        msgspec.structs.replace(message.objects[0], **fields)


@pytest.mark.parametrize(
    ("example", "fields", "error"),
    [
        ("loop_closure", {"overlap": 1.5}, "overlap is 1.5"),
        ("loop_closure", {"overlap": NAN}, "overlap is nan"),
        ("loop_closure", {"rmse_m": -1.0}, "rmse_m is -1"),
        ("loop_closure", {"entropy": INF}, "entropy holds NaN or infinity"),
        ("loop_candidate", {"similarity": -0.5}, "similarity is -0.5"),
        ("loop_candidate", {"inliers": -1}, "inliers is -1"),
        ("loop_candidate", {"rejected_reason": "x" * 101}, "has 101 characters"),
        (
            "loop_candidate",
            {"rejected_reason": "", "evidence": ""},
            "a candidate without evidence has no pose and must have a rejected_reason",
        ),
    ],
)
def test_invalid_loop_closure_or_candidate_is_rejected(
    example: str, fields: dict[str, Any], error: str
) -> None:
    with pytest.raises(ValueError, match=error):
        changed(example, **fields)


def test_loop_closure_with_a_newer_reference_is_rejected() -> None:
    message = EXAMPLES["loop_closure"]
    assert isinstance(message, LoopClosure)
    reversed_pose = msgspec.structs.replace(message.pose, reference=9, keyframe=1)
    with pytest.raises(ValueError, match="newer keyframe 9"):
        changed("loop_closure", pose=reversed_pose)


def test_repeated_object_ids_are_rejected() -> None:
    message = EXAMPLES["map_objects"]
    assert isinstance(message, MapObjects)
    with pytest.raises(ValueError, match="ascending"):
        changed("map_objects", objects=2 * message.objects)


@pytest.mark.parametrize(
    ("others", "error"),
    [
        ((("cup", 1.5),), "must be within 0..1"),
        ((("cup", NAN),), "holds NaN"),
        ((("x" * 101, 0.1),), "101 characters"),
        ((("", 0.0),), "none may be empty"),
        ((("cup", 0.2), ("cup", 0.1)), "must be different"),
        ((("samovar", 0.1),), "must be different"),
        (tuple((f"name {k}", 0.1) for k in range(9)), "9 alternatives, must have at most 8"),
    ],
)
def test_invalid_label_alternatives_are_rejected(others: tuple, error: str) -> None:
    with pytest.raises(ValueError, match=error):
        changed("label_result", alternatives=others)
    with pytest.raises(ValueError, match="none may be empty"):
        changed("label_result", label="", confidence=0.0, alternatives=(("cup", 0.1),))
