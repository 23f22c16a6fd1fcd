"""Recordings of Azure Kinect, written by PyAV as k4arecorder writes them."""

import builtins
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.errors import ConfigError, DataError, FrameError
from ldo_service.geometry import Camera
from ldo_service.geometry.registration import register_depth

from .recordings import T_COLOR_DEPTH, azure_calibration, write_azure

COLOR = Camera(1280, 720, 600.0, 605.0, 640.0, 362.0, (0.1, -0.05, 1e-3, -1e-3, 0.01, 0, 0, 0))
DEPTH = Camera(320, 288, 252.0, 253.0, 160.0, 144.0, (0.2, -0.05, 1e-4, -1e-4, 0.01, 0.3, 0, 0))
IMAGES = [
    (np.full((720, 1280, 3), (40 + 20 * k, 100, 180), np.uint8), np.full((288, 320), 1500 + k))
    for k in range(4)
]
CALIBRATION: Any = azure_calibration(COLOR, DEPTH)
ENCODINGS = {
    "MJPEG": ("mjpeg", "yuvj422p"),
    "NV12": ("rawvideo", "nv12"),
    "YUY2": ("rawvideo", "yuyv422"),
    "BGRA": ("rawvideo", "bgra"),
}


@pytest.mark.parametrize("encoding", ENCODINGS.values(), ids=ENCODINGS)
def test_frames_are_those_of_the_file(tmp_path: Path, encoding: tuple[str, str]) -> None:
    path = write_azure(tmp_path / "desk.mkv", IMAGES, CALIBRATION, *encoding)
    sequence = open_sequence(str(path))
    assert (sequence.name, len(sequence), sequence.registration) == ("desk", 4, "reader")
    assert sequence.stamps_ns.tolist() == [0, 33_000_000, 67_000_000, 100_000_000]
    assert sequence.depth_offsets_ns is not None
    assert not sequence.depth_offsets_ns.any()
    assert (sequence.raw_camera.width, sequence.raw_camera.height) == (640, 360)
    for k in (2, 0, 3, 1):
        raw = sequence.read(k)
        assert np.max(np.abs(raw.color.astype(int) - IMAGES[k][0][0, 0])) <= 5
        depth_m = IMAGES[k][1].astype(np.float32) / 1000
        expected = register_depth(depth_m, DEPTH, sequence.raw_camera, T_COLOR_DEPTH)
        np.testing.assert_allclose(raw.depth_m(), expected, atol=1e-6)
        assert expected.any()
    assert sequence.truth() is None


def test_cameras_have_pixel_centers_at_integer_coordinates(tmp_path: Path) -> None:
    """Project a point by the conventions of the camera's own software, and by those here."""
    path = write_azure(tmp_path / "a.mkv", IMAGES[:1], CALIBRATION)
    grid = open_sequence(str(path)).raw_camera
    entry = CALIBRATION["CalibrationInformation"]["Cameras"][1]
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = entry["Intrinsics"]["ModelParameters"]
    x, y = 0.2, -0.1
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = 1280 * (cx + fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)))
    v = 960 * (cy + fy * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y))) - 120
    projected, _ = cv2.projectPoints(
        np.array([[x, y, 1.0]]), np.zeros(3), np.zeros(3), grid.matrix, np.array(grid.distortion)
    )
    # A pixel here is a block of 2x2, and its center is at an integer coordinate.
    np.testing.assert_allclose(projected.ravel(), [u / 2 - 0.5, v / 2 - 0.5], atol=1e-9)


def changed(camera: int, key: str, value: object) -> Any:
    """Return the calibration with one value of a camera replaced."""
    cameras = [dict(entry) for entry in CALIBRATION["CalibrationInformation"]["Cameras"]]
    cameras[camera][key] = value
    return {"CalibrationInformation": {"Cameras": cameras}}


@pytest.mark.parametrize(
    ("calibration", "message"),
    [
        (None, r"has no attachment calibration\.json; its video streams are: COLOR, DEPTH"),
        ({}, "does not have the expected values .KeyError: 'CalibrationInformation'"),
        (
            {"CalibrationInformation": {"Cameras": 3}},
            r"`CalibrationInformation\.Cameras` must be a list",
        ),
        (changed(1, "Location", "x"), "KeyError: 'CALIBRATION_CameraLocationPV0'"),
        (
            changed(0, "Intrinsics", {"ModelParameters": [1]}),
            "`ModelParameters` must be a list of 14",
        ),
        (changed(0, "Intrinsics", {"ModelParameters": ["x"] * 14}), "expected a finite number"),
        (changed(0, "Intrinsics", {"ModelParameters": [0.0] * 14}), "focal length"),
        (
            changed(1, "Rt", {"Rotation": [2] * 9, "Translation": [0] * 3}),
            "must be a rigid transform",
        ),
        (changed(1, "Rt", {"Rotation": [2], "Translation": [0] * 3}), "ValueError"),
    ],
)
def test_invalid_calibration_is_named(tmp_path: Path, calibration: Any, message: str) -> None:
    path = write_azure(tmp_path / "a.mkv", IMAGES[:1], calibration)
    with pytest.raises(DataError, match=rf"a\.mkv.*{message}") as caught:
        open_sequence(str(path))
    assert "\n" not in str(caught.value)


def test_depth_of_another_size_is_named(tmp_path: Path) -> None:
    images = [(IMAGES[0][0], np.zeros((24, 32)))]
    path = write_azure(tmp_path / "a.mkv", images, CALIBRATION)
    with pytest.raises(DataError, match="depth has 32x24 pixels, expected one of 320x288"):
        open_sequence(str(path))


@pytest.mark.parametrize("length", [0, 100, 3000])
def test_truncated_file_is_named(tmp_path: Path, length: int) -> None:
    path = write_azure(tmp_path / "a.mkv", IMAGES, CALIBRATION)
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(DataError, match=r"a\.mkv"):
        open_sequence(str(path))


def test_file_without_its_last_frames_has_the_others(tmp_path: Path) -> None:
    path = write_azure(tmp_path / "a.mkv", IMAGES, CALIBRATION)
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    sequence = open_sequence(str(path))
    assert 0 < len(sequence) < 4
    assert sequence.read(0).index == 0
    with suppress(FrameError):  # The last frame may be incomplete.
        assert sequence.read(len(sequence) - 1).index == len(sequence) - 1


def test_missing_library_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_azure(tmp_path / "a.mkv", IMAGES[:1], CALIBRATION)
    real = builtins.__import__

    def without_av(name: str, *arguments: Any, **options: Any) -> Any:
        if name.partition(".")[0] == "av":
            raise ImportError(name)
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without_av)
    with pytest.raises(ConfigError, match="extra `phones`"):
        open_sequence(str(path))
