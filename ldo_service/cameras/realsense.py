"""A RealSense camera on USB: depth aligned to colour, intrinsics and units from the device."""

import sys
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, DataError
from ldo_service.schemas import CameraModel, CameraRgbd, Image

WAIT_MS = 5000  # for a frame: the first may take two seconds
GRID = 16, 12  # points over the image that the lens is fitted at
MAX_FIT_PX = 0.5  # of OpenCV's lens against the device's own


@dataclass(frozen=True, slots=True)
class RealSenseStream:
    """serial: of the device; empty: the only one. Colour and depth have one size and rate."""

    serial: str = ""
    width: int = 640
    height: int = 480
    rate_hz: int = 30


def library() -> Any:
    """Raises ConfigError without the extra `realsense`."""
    try:
        import pyrealsense2  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ConfigError(
            "a RealSense needs the extra `realsense`: "
            f"`{sys.executable} -m pip install 'ldo-slam[realsense]'`."
        ) from error
    return pyrealsense2


def frames(stream: RealSenseStream) -> Generator[CameraRgbd, None, None]:
    """For ever. Raises ConfigError when no camera has such a stream, DataError when it ends."""
    rs = library()
    _require_device(rs, stream.serial)
    pipeline = rs.pipeline()
    try:
        profile = pipeline.start(_config(rs, stream))
    except RuntimeError as error:
        raise ConfigError(
            f"the RealSense does not send {stream.width}x{stream.height} at {stream.rate_hz} Hz "
            f"({error}): does another program use it? `rs-enumerate-devices` lists what it can."
        ) from error
    try:
        color = profile.get_stream(rs.stream.color).as_video_stream_profile()
        yield from messages(rs, pipeline, camera_model(rs, color.get_intrinsics()))
    finally:
        pipeline.stop()


def messages(rs: Any, source: Any, camera: CameraModel) -> Iterator[CameraRgbd]:
    """Frames of a `pipeline`, or whatever has its `wait_for_frames`, with depth in the pixels of
    `camera`, which is colour's. Raises DataError when no more come."""
    align, frame = rs.align(rs.stream.color), 0
    while True:
        try:
            both = align.process(source.wait_for_frames(WAIT_MS))
        except RuntimeError as error:
            raise DataError(f"the RealSense sends no more frames: {error}.") from error
        color, depth = both.get_color_frame(), both.get_depth_frame()
        if color and depth:
            yield CameraRgbd(
                stamp_ns=round(color.get_timestamp() * 1e6),
                frame=frame,
                camera=camera,
                color=Image.raw("rgb8", np.asanyarray(color.get_data())),
                depth=Image.raw("z16", np.asanyarray(depth.get_data())),
                depth_scale=1 / round(depth.get_units(), 9),  # a float32
            )
            frame += 1


def camera_model(rs: Any, intrinsics: Any) -> CameraModel:
    """With OpenCV's lens, fitted to the device's own model, which may be another.

    A point of the undistorted image at (x, y), r^2 = x^2 + y^2, is seen at

        x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), and y likewise,

    which is linear in the coefficients. Raises ConfigError where that misses by over half a pixel.
    """
    fx, fy = intrinsics.fx, intrinsics.fy
    distortion: tuple[float, ...] = ()
    if any(intrinsics.coeffs):
        seen, x, y = _seen_through(rs, intrinsics)
        distortion, error_px = _fitted(seen, x, y, max(fx, fy))
        if error_px > MAX_FIT_PX:
            raise ConfigError(
                f"the lens of this RealSense ({intrinsics.model}) differs from OpenCV's model by "
                f"{error_px:.1f} px: it is too wide for this."
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
    """A pipeline would wait 15 s for it."""
    devices = rs.context().query_devices()
    found = [device.get_info(rs.camera_info.serial_number) for device in devices]
    if not found or (serial and serial not in found):
        raise ConfigError(
            f"no RealSense {serial + ' ' if serial else ''}was found (there is "
            f"{', '.join(found) or 'none'}): is it plugged in, and may you read USB devices?"
        )


def _config(rs: Any, stream: RealSenseStream) -> Any:
    config, size = rs.config(), (stream.width, stream.height)
    if stream.serial:
        config.enable_device(stream.serial)
    config.enable_stream(rs.stream.color, *size, rs.format.rgb8, stream.rate_hz)
    config.enable_stream(rs.stream.depth, *size, rs.format.z16, stream.rate_hz)
    return config


def _seen_through(rs: Any, intrinsics: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where points of a grid are seen, [N, 2] over the focal lengths, and their x and y [N]
    without the lens. Each model is asked in the direction that it is defined in."""
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
    """k1 k2 p1 p2 k3, and the largest error in pixels."""
    r2 = x * x + y * y
    of_x = np.stack([r2 * x, r2**2 * x, 2 * x * y, r2 + 2 * x * x, r2**3 * x], axis=1)
    of_y = np.stack([r2 * y, r2**2 * y, r2 + 2 * y * y, 2 * x * y, r2**3 * y], axis=1)
    system = np.concatenate([of_x, of_y])
    moved = np.concatenate([seen[:, 0] - x, seen[:, 1] - y])
    coefficients = np.linalg.lstsq(system, moved, rcond=None)[0]
    error_px = float(np.abs(system @ coefficients - moved).max()) * focal_px
    return tuple(coefficients.tolist()), error_px
