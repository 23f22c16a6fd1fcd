"""Frames of a RealSense on USB, with depth aligned to color and the device's intrinsics."""

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, DataError, install_command
from ldo_service.schemas import CameraModel, CameraRgbd, Image

WAIT_MS = 5000  # Maximum time to wait for a frame; the first one may take two seconds.
GRID = 16, 12  # Columns and rows of the image points that the lens distortion is fitted to.
MAX_FIT_PX = 0.5  # Maximum difference between OpenCV's and the device's distortion model, pixels.


@dataclass(frozen=True, slots=True)
class RealSenseStream:
    """Stream settings of a RealSense; color and depth have the same size and rate."""

    serial: str = ""  # Serial number of the device; empty if there is only one.
    width: int = 640  # Pixels, as the height.
    height: int = 480
    rate_hz: int = 30


def library() -> Any:
    """Return the module pyrealsense2.

    Raises:
        ConfigError: The extra `realsense` is not installed.
    """
    try:
        import pyrealsense2  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError(
            "a RealSense needs the extra `realsense`. Install it by "
            f"{install_command('realsense')}."
        ) from error
    return pyrealsense2


def frames(stream: RealSenseStream) -> Generator[CameraRgbd, None, None]:
    """Open a RealSense, and iterate over its frames without end.

    Raises:
        ConfigError: No RealSense is connected, or the device does not support the stream settings.
        DataError: The camera stopped sending frames.
    """
    rs = library()
    _require_device(rs, stream.serial)
    pipeline = rs.pipeline()
    try:
        profile = pipeline.start(_config(rs, stream))
    except RuntimeError as error:
        raise ConfigError(
            f"the RealSense cannot stream {stream.width}x{stream.height} at {stream.rate_hz} Hz "
            f"({error}). Check that no other program uses the camera. Choose a stream that "
            "`rs-enumerate-devices` lists."
        ) from error
    try:
        color = profile.get_stream(rs.stream.color).as_video_stream_profile()
        yield from messages(rs, pipeline, camera_model(rs, color.get_intrinsics()))
    finally:
        pipeline.stop()


def messages(rs: Any, source: Any, camera: CameraModel) -> Iterator[CameraRgbd]:
    """Iterate over the frames of a pipeline, with depth aligned to color.

    Args:
        rs: The module pyrealsense2.
        source: A `pipeline`, or another object with the method `wait_for_frames`.
        camera: The color camera.

    Raises:
        DataError: The source stopped sending frames.
    """
    align, frame = rs.align(rs.stream.color), 0
    while True:
        try:
            both = align.process(source.wait_for_frames(WAIT_MS))
        except RuntimeError as error:
            raise DataError(
                f"the RealSense sends no more frames: {error}. Check its USB connection."
            ) from error
        color, depth = both.get_color_frame(), both.get_depth_frame()
        if color and depth:
            yield CameraRgbd(
                stamp_ns=round(color.get_timestamp() * 1e6),
                frame=frame,
                camera=camera,
                color=Image.raw("rgb8", np.asanyarray(color.get_data())),
                depth=Image.raw("z16", np.asanyarray(depth.get_data())),
                # get_units() returns meters per unit as float32; rounding restores the decimal
                # value.
                depth_scale=1 / round(depth.get_units(), 9),
            )
            frame += 1


def camera_model(rs: Any, intrinsics: Any) -> CameraModel:
    """Return the camera model with OpenCV's distortion, fitted to the model of the device.

    OpenCV's model maps an undistorted point (x, y), with r^2 = x^2 + y^2, to the distorted x

        x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2),

    and y likewise. The model is linear in its coefficients, so least squares can fit them.

    Args:
        rs: The module pyrealsense2.
        intrinsics: Intrinsics of the device.

    Raises:
        ConfigError: The error of the fit exceeds half a pixel.
    """
    fx, fy = intrinsics.fx, intrinsics.fy
    distortion: tuple[float, ...] = ()
    if any(intrinsics.coeffs):
        seen, x, y = _seen_through(rs, intrinsics)
        distortion, error_px = _fitted(seen, x, y, max(fx, fy))
        if error_px > MAX_FIT_PX:
            raise ConfigError(
                f"the lens of this RealSense ({intrinsics.model}) differs from OpenCV's model by "
                f"{error_px:.1f} px, expected at most {MAX_FIT_PX} px. The lens is too wide for "
                "that model. Use a camera with a narrower lens."
            )
    return CameraModel(
        width=intrinsics.width,
        height=intrinsics.height,
        fx=fx,
        fy=fy,
        cx=intrinsics.ppx,
        cy=intrinsics.ppy,
        distortion=distortion,
    )


def _require_device(rs: Any, serial: str) -> None:
    """Raise ConfigError immediately if the device is not connected.

    Without this check, the pipeline of the camera would wait 15 s for the device.
    """
    devices = rs.context().query_devices()
    found = [device.get_info(rs.camera_info.serial_number) for device in devices]
    if not found or (serial and serial not in found):
        raise ConfigError(
            f"no RealSense {serial + ' ' if serial else ''}was found (connected: "
            f"{', '.join(found) or 'none'}). Check the USB connection and the permission to read "
            "USB devices."
        )


def _config(rs: Any, stream: RealSenseStream) -> Any:
    config, size = rs.config(), (stream.width, stream.height)
    if stream.serial:
        config.enable_device(stream.serial)
    config.enable_stream(rs.stream.color, *size, rs.format.rgb8, stream.rate_hz)
    config.enable_stream(rs.stream.depth, *size, rs.format.z16, stream.rate_hz)
    return config


def _seen_through(rs: Any, intrinsics: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample the distortion model of the device on a grid of points.

    The inverse Brown-Conrady model maps distorted to undistorted points, so its grid consists of
    distorted points. All other models map in the opposite direction, so their grid consists of
    undistorted points.

    Returns:
        Distorted coordinates [N, 2], and undistorted coordinates x and y [N]; all are normalized by
        the focal length.
    """
    columns = np.linspace(0, intrinsics.width - 1, GRID[0])
    rows = np.linspace(0, intrinsics.height - 1, GRID[1])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    center = np.array([intrinsics.ppx, intrinsics.ppy])
    focal = np.array([intrinsics.fx, intrinsics.fy])
    straight = (pixels - center) / focal
    if intrinsics.model == rs.distortion.inverse_brown_conrady:
        points = [rs.rs2_deproject_pixel_to_point(intrinsics, p, 1.0)[:2] for p in pixels.tolist()]
        return straight, *np.array(points).T
    there = [rs.rs2_project_point_to_pixel(intrinsics, [*p, 1.0]) for p in straight.tolist()]
    return (np.array(there) - center) / focal, *straight.T


def _fitted(
    seen: np.ndarray, x: np.ndarray, y: np.ndarray, focal_px: float
) -> tuple[tuple[float, ...], float]:
    """Fit OpenCV's distortion coefficients to samples.

    Args:
        seen: Distorted coordinates, [N, 2], normalized by the focal length.
        x: Undistorted x coordinates, [N], normalized likewise.
        y: Undistorted y coordinates, [N], normalized likewise.
        focal_px: Focal length in pixels.

    Returns:
        The coefficients k1 k2 p1 p2 k3, and the maximum error in pixels.
    """
    r2 = x * x + y * y
    of_x = np.stack([r2 * x, r2**2 * x, 2 * x * y, r2 + 2 * x * x, r2**3 * x], axis=1)
    of_y = np.stack([r2 * y, r2**2 * y, r2 + 2 * y * y, 2 * x * y, r2**3 * y], axis=1)
    system = np.concatenate([of_x, of_y])
    moved = np.concatenate([seen[:, 0] - x, seen[:, 1] - y])
    coefficients = np.linalg.lstsq(system, moved, rcond=None)[0]
    error_px = float(np.abs(system @ coefficients - moved).max()) * focal_px
    return tuple(coefficients.tolist()), error_px
