"""Images and camera infos in CDR, serialized by rosbags; invalid messages raise FrameError."""

import struct
import sys

import cv2
import numpy as np
import pytest

from ldo_service.cameras.ros_messages import (
    RosImage,
    joined,
    read_camera,
    read_color,
    read_depth,
    typestore,
)
from ldo_service.errors import ConfigError, FrameError
from ldo_service.geometry import codecs
from ldo_service.schemas import CameraModel

from .ros import (
    COLOR,
    DEPTH_MM,
    FRAME_ID,
    HEIGHT,
    WIDTH,
    camera_info,
    cdr,
    compressed,
    header,
    image,
)

ALPHA = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
JPEG = codecs.encode_jpeg(COLOR)
PNG16 = cv2.imencode(".png", DEPTH_MM)[1].tobytes()
BGR = COLOR[..., ::-1]


def color_of(read: RosImage) -> np.ndarray:
    i = read.image
    return codecs.decode_color(i.encoding, i.width, i.height, i.data)


def depth_m_of(read: RosImage) -> np.ndarray:
    i = read.image
    return codecs.decode_depth(i.encoding, i.width, i.height, i.data) / read.depth_scale


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", COLOR),
        ("bgr8", BGR),
        ("rgba8", np.concatenate([COLOR, ALPHA], axis=2)),
        ("bgra8", np.concatenate([BGR, ALPHA], axis=2)),
    ],
)
def test_color_is_rgb_whatever_its_encoding(
    encoding: str, pixels: np.ndarray, padding: int, little_endian: bool
) -> None:
    body = cdr(image(encoding, pixels, padding=padding), little_endian=little_endian)
    read = read_color(body, "/camera/image_raw")
    assert (read.stamp_ns, read.frame_id) == (1_500_000_002, FRAME_ID)
    np.testing.assert_array_equal(color_of(read), COLOR)


def test_gray_is_the_same_in_all_colors() -> None:
    read = read_color(cdr(image("mono8", COLOR[..., 0])), "/camera/image_raw")
    np.testing.assert_array_equal(color_of(read), np.repeat(COLOR[..., :1], 3, axis=2))


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1"])
def test_depth_is_in_meters_whatever_its_encoding(encoding: str, order: str, padding: int) -> None:
    kind, units = ("f4", 1000) if encoding == "32FC1" else ("u2", 1)
    depth = (DEPTH_MM / units).astype(order + kind)
    read = read_depth(cdr(image(encoding, depth, padding=padding)), "/camera/depth")
    np.testing.assert_allclose(depth_m_of(read), DEPTH_MM / 1000, rtol=1e-6)


def test_missing_depth_stays_nan_in_floats() -> None:
    depth = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    assert np.isnan(depth_m_of(read_depth(cdr(image("32FC1", depth)), "/depth"))).all()


def test_compressed_images_are_passed_on_unchanged() -> None:
    color = read_color(cdr(compressed("rgb8; jpeg compressed bgr8", JPEG)), "/image_raw/compressed")
    assert (color.image.encoding, bytes(color.image.data)) == ("jpeg", JPEG)
    message = compressed("16UC1; compressedDepth png", bytes(12) + PNG16)
    depth = read_depth(cdr(message), "/depth/compressedDepth")
    np.testing.assert_array_equal(depth_m_of(depth), DEPTH_MM / 1000)


def test_camera_model_is_k_and_d_or_p_for_rectified_images() -> None:
    body = cdr(camera_info())
    raw, rectified = read_camera(body, False), read_camera(body, True)
    assert (raw.fx, raw.fy, raw.cx, raw.cy) == (7.0, 7.5, 3.5, 2.5)
    assert raw.distortion == (0.1, -0.2, 0.001, 0.002, 0.03)
    assert (rectified.fx, rectified.fy, rectified.cx, rectified.cy) == (6.0, 6.5, 3.25, 2.25)
    assert rectified.distortion == ()


def test_zero_coefficients_mean_no_distortion_in_any_model() -> None:
    info = camera_info(distortion_model="equidistant", d=np.zeros(4))
    assert read_camera(cdr(info), False).distortion == ()


@pytest.mark.parametrize(
    ("info", "expected"),
    [
        (camera_info(distortion_model="equidistant", d=np.ones(4)), "equidistant.*--rectified"),
        (camera_info(k=np.zeros(9)), "focal lengths are 0"),
        (camera_info(k=np.full(9, np.nan)), "NaN"),
        (camera_info(d=np.ones(3)), "distortion has 3 coefficients"),
        (camera_info(width=0), "image size is 0x6"),
    ],
)
def test_invalid_camera_info_is_rejected(info, expected: str) -> None:
    with pytest.raises(FrameError, match=expected):
        read_camera(cdr(info), False)


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (
            image("bayer_rggb8", COLOR[..., 0]),
            "'bayer_rggb8' is not supported. Set the camera driver to one of rgb8",
        ),
        (
            image("rgb8", COLOR, step=23),
            "rows of at least 24 bytes, but has 144 bytes with 23 per row",
        ),
        (image("rgb8", COLOR, height=7), "has 144 bytes"),
        (image("rgb8", COLOR, data=np.zeros(3, np.uint8)), "has 3 bytes"),
        (image("rgb8", COLOR, width=0), "0x6 pixels, expected 1 to"),
        (image("rgb8", COLOR, width=2**31, height=2**31), "33554432"),
        (
            camera_info(),
            "cannot be decoded as sensor_msgs/msg/Image|is not supported|rows of|pixels",
        ),
    ],
)
def test_inconsistent_color_image_is_rejected(message, expected: str) -> None:
    with pytest.raises(FrameError, match=expected):
        read_color(cdr(message), "/image_raw")


@pytest.mark.parametrize("length", [0, 1, 3, 4, 20, 40, 100, -1])
def test_truncated_cdr_is_rejected(length: int) -> None:
    body = cdr(image("rgb8", COLOR))
    for read in (read_color, read_depth):
        with pytest.raises(FrameError):
            read(body[:length], "/image_raw")
    with pytest.raises(FrameError):
        read_camera(cdr(camera_info())[:length], False)


def test_cdr_of_another_version_is_rejected() -> None:
    with pytest.raises(FrameError, match="not CDR of ROS 2"):
        read_color(b"\0\7\0\0" + cdr(image("rgb8", COLOR))[4:], "/image_raw")


@pytest.mark.parametrize("kind", ["8UC1; compressedDepth png", "jpeg"])
def test_compressed_depth_of_another_kind_is_rejected(kind: str) -> None:
    with pytest.raises(FrameError, match="16UC1 or 32FC1"):
        read_depth(cdr(compressed(kind, bytes(12) + PNG16)), "/depth/compressedDepth")


def test_compressed_depth_in_meters_is_decoded() -> None:
    """The quantization is that of compressed_depth_image_transport with its default settings."""
    depth_m = np.linspace(0.3, 9.9, DEPTH_MM.size, dtype=np.float32).reshape(DEPTH_MM.shape)
    A = 100.0 * (100.0 + 1.0)
    B = 1.0 - A / 10.0
    stored = (A / depth_m + B).astype(np.uint16)
    stored[0, 0] = 0
    png = cv2.imencode(".png", stored)[1].tobytes()
    message = compressed("32FC1; compressedDepth png", struct.pack("<iff", 0, A, B) + png)
    read = depth_m_of(read_depth(cdr(message), "/depth/compressedDepth"))
    assert np.isnan(read[0, 0])
    # A step of the integer changes the depth by depth^2 / A.
    error_m = np.abs(read - depth_m).reshape(-1)[1:]
    assert (error_m <= (depth_m * depth_m / A * 1.05).reshape(-1)[1:]).all()


@pytest.mark.parametrize("length", [0, 5, 12, 30])
def test_truncated_compressed_depth_is_rejected(length: int) -> None:
    body = struct.pack("<iff", 0, 1.0, 1.0) + PNG16
    with pytest.raises(FrameError, match="neither PNG nor JPEG"):
        read_depth(cdr(compressed("32FC1; compressedDepth png", body[:length])), "/d/compressed")


def test_depth_as_plain_png_is_read() -> None:
    message = compressed("16UC1; png compressed", PNG16)
    read = read_depth(cdr(message), "/depth/image_raw/compressed")
    np.testing.assert_array_equal(depth_m_of(read), DEPTH_MM / 1000)


def test_compressed_data_without_an_image_are_rejected() -> None:
    with pytest.raises(FrameError, match="neither PNG nor JPEG"):
        read_color(cdr(compressed("jpeg", b"\xff\xd8")), "/image_raw/compressed")


# --- frames ---------------------------------------------------------------------------------------
CAMERA = read_camera(cdr(camera_info()), False)


def depth_of(frame_id: str = FRAME_ID, pixels: np.ndarray = DEPTH_MM) -> RosImage:
    return read_depth(cdr(image("16UC1", pixels, header(frame_id=frame_id))), "/depth")


def frame_of(depth: RosImage, camera: CameraModel = CAMERA, is_registered: bool = False):
    color = read_color(cdr(image("rgb8", COLOR)), "/image_raw")
    return joined(color, depth, camera, 3, is_registered)


def test_a_frame_has_both_images_and_the_stamp_of_color() -> None:
    frame = frame_of(depth_of())
    assert (frame.frame, frame.stamp_ns, frame.depth_scale) == (3, 1_500_000_002, 1000)
    assert frame.camera == CAMERA


def test_depth_of_another_frame_is_rejected_unless_declared_registered() -> None:
    with pytest.raises(FrameError, match=r"align_depth.*--registered"):
        frame_of(depth_of("camera_depth_optical_frame"))
    assert frame_of(depth_of("camera_depth_optical_frame"), is_registered=True).frame == 3


def test_sizes_that_differ_are_rejected() -> None:
    with pytest.raises(FrameError, match="differ in size"):
        frame_of(depth_of(pixels=DEPTH_MM[:4]))
    with pytest.raises(FrameError, match="8x6 pixels, but its camera info states 8x5"):
        frame_of(depth_of(), read_camera(cdr(camera_info(height=5)), False))


def test_a_stamp_before_the_epoch_is_rejected() -> None:
    color = read_color(cdr(image("rgb8", COLOR, header(-(10**9)))), "/image_raw")
    with pytest.raises(FrameError, match="stamp_ns"):
        joined(color, depth_of(), CAMERA, 0, False)


def test_missing_library_is_an_error_with_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(ConfigError, match=r"pip install -e '\.\[ros2\]'"):
        typestore.__wrapped__()
