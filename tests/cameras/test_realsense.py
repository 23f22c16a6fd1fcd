"""The RealSense camera, replaced by librealsense's software device."""

import sys
from itertools import islice

import numpy as np
import pytest

from ldo_service.cameras.realsense import (
    RealSenseStream,
    camera_model,
    frames,
    library,
    messages,
)
from ldo_service.conversions.frames import camera_from_message
from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import Camera, camera

rs = pytest.importorskip("pyrealsense2", reason="needs `pip install -e '.[realsense]'`")

WIDTH, HEIGHT = 64, 48
BASELINE_M, DEPTH_M, UNITS_M = 0.05, 1.5, 0.0005
LENS = [0.05, -0.03, 0.002, -0.001, 0.01]


def intrinsics(focal: float, model=None, coefficients=(0.0,) * 5):
    made = rs.intrinsics()
    made.width, made.height, made.ppx, made.ppy = WIDTH, HEIGHT, 31.0, 23.0
    made.fx = made.fy = focal
    made.model = rs.distortion.none if model is None else model
    made.coeffs = list(coefficients)
    return made


def stream(kind, form, bytes_per_pixel: int, camera):
    made = rs.video_stream()
    made.type, made.fmt, made.bpp, made.uid = kind, form, bytes_per_pixel, int(kind)
    made.width, made.height, made.fps, made.intrinsics = WIDTH, HEIGHT, 30, camera
    return made


class SoftwareCamera:
    """A depth and a color camera side by side before a wall, as a pipeline of nine frames."""

    def __init__(self) -> None:
        self.device = rs.software_device()
        self.sensors = self.device.add_sensor("Depth"), self.device.add_sensor("Color")
        self.sensors[0].add_read_only_option(rs.option.depth_units, UNITS_M)
        cameras = intrinsics(50.0), intrinsics(50.0)
        depth = stream(rs.stream.depth, rs.format.z16, 2, cameras[0])
        color = stream(rs.stream.color, rs.format.rgb8, 3, cameras[1])
        self.profiles = [
            sensor.add_video_stream(made)
            for sensor, made in zip(self.sensors, (depth, color), strict=True)
        ]
        beside = rs.extrinsics()
        beside.rotation, beside.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [BASELINE_M, 0, 0]
        self.profiles[0].register_extrinsics_to(self.profiles[1], beside)
        self.device.create_matcher(rs.matchers.dlr_c)
        self.syncer, self.number = rs.syncer(), 0
        for sensor, profile in zip(self.sensors, self.profiles, strict=True):
            sensor.open(profile)
            sensor.start(self.syncer)

    def wait_for_frames(self, timeout_ms: int):
        self.number += 1
        if self.number > 9:
            raise RuntimeError(f"Frame didn't arrive within {timeout_ms}")
        depth = np.full((HEIGHT, WIDTH), DEPTH_M / UNITS_M, np.uint16)
        color = np.full((HEIGHT, WIDTH, 3), (self.number, 20, 30), np.uint8)
        for sensor, profile, pixels in zip(
            self.sensors, self.profiles, (depth, color), strict=True
        ):
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp = pixels, pixels[0, 0].nbytes
            frame.stride, frame.profile = pixels[0].nbytes, profile.as_video_stream_profile()
            frame.timestamp, frame.frame_number = self.number * 33.25, self.number
            frame.domain, frame.depth_units = rs.timestamp_domain.hardware_clock, UNITS_M
            sensor.on_video_frame(frame)
        return self.syncer.wait_for_frames(timeout_ms)


def test_depth_is_aligned_to_color_in_device_units() -> None:
    camera = SoftwareCamera()
    sent = messages(rs, camera, camera_model(rs, intrinsics(50.0)))
    *_, frame = islice(sent, 5)
    assert frame.frame == 4
    assert frame.stamp_ns == bytes(frame.color.data)[0] * 33_250_000
    assert frame.depth_scale == pytest.approx(1 / UNITS_M)
    depth_m = np.frombuffer(frame.depth.data, "<u2").reshape(HEIGHT, WIDTH) / frame.depth_scale
    moved_px = round(50 * BASELINE_M / DEPTH_M)
    assert moved_px == 2
    assert not depth_m[:, : moved_px - 1].any(), "depth does not see what color sees there"
    seen = depth_m[:, moved_px + 1 : -1]
    assert set(np.unique(seen)) <= {0.0, DEPTH_M}
    assert (seen > 0).mean() > 0.9, "librealsense leaves single pixels out"
    with pytest.raises(DataError, match="no more frames"):
        list(sent)


def test_camera_without_distortion_has_no_coefficients() -> None:
    camera = camera_from_message(camera_model(rs, intrinsics(50.0)))
    assert camera == Camera(WIDTH, HEIGHT, 50.0, 50.0, 31.0, 23.0)


@pytest.mark.parametrize(
    "name", ["brown_conrady", "inverse_brown_conrady", "modified_brown_conrady"]
)
def test_opencv_lens_model_agrees_with_librealsense(name: str) -> None:
    """The reference is librealsense, which projects a point or deprojects a pixel."""
    theirs = intrinsics(50.0, getattr(rs.distortion, name), LENS)
    ours = camera_from_message(camera_model(rs, theirs))
    if name == "brown_conrady":
        np.testing.assert_allclose(ours.distortion, LENS, atol=1e-5)
    for pixel in ((3.0, 5.0), (31.0, 23.0), (60.0, 40.0), (10.0, 44.0)):
        if name == "inverse_brown_conrady":
            point, seen = rs.rs2_deproject_pixel_to_point(theirs, list(pixel), 1.0), pixel
        else:
            point = [(pixel[0] - 31) / 50, (pixel[1] - 23) / 50, 1.0]
            seen = rs.rs2_project_point_to_pixel(theirs, point)
        u, v = camera.project(np.array([[point[0]]]), np.array([[point[1]]]), ours)
        assert (float(u[0, 0]), float(v[0, 0])) == pytest.approx(tuple(seen), abs=0.05)


def test_lens_without_an_opencv_model_is_rejected() -> None:
    fisheye = intrinsics(20.0, rs.distortion.kannala_brandt4, [0.9, -0.8, 0.5, -0.2, 0.0])
    with pytest.raises(ConfigError, match="too wide"):
        camera_model(rs, fisheye)


def test_missing_camera_is_a_config_error() -> None:
    if len(rs.context().query_devices()):
        pytest.skip("a RealSense is plugged in")
    with pytest.raises(ConfigError, match="no RealSense was found"):
        next(frames(RealSenseStream()))


def test_missing_library_is_an_error_with_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(ConfigError, match=r"ldo-slam\[realsense\]"):
        library()
