"""Recordings of Azure Kinect and Femto cameras: files .mkv of k4arecorder.

The video streams have the titles COLOR (MJPEG, NV12, YUY2 or BGRA) and DEPTH (16-bit gray,
big-endian, millimeters). The attachment calibration.json has a list CalibrationInformation.Cameras.
In this list, the color camera has the location CALIBRATION_CameraLocationPV0, and the depth camera
has the location CALIBRATION_CameraLocationD0. Each of the two cameras has these values:

    Intrinsics.ModelParameters   14 numbers: cx, cy, fx, fy as fractions of the calibrated image;
                                 k1 to k6; 0, 0; p2, p1
    Rt.Rotation, Rt.Translation  transform from depth camera to this camera, by rows, meters

In each mode of a camera, its images are a part of the calibrated image; see `_color_camera` and
DEPTH_MODES. Pixel centers have integer coordinates in this project, and coordinates such as 0.5 and
1.5 in the calibration. Color is averaged to a grid about 640 pixels wide, as for phones, and depth
is registered to this grid. Infrared images and inertial measurements are not read.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, DataError, install_command
from ldo_service.geometry import Camera, RawFrame, Trajectory, se3
from ldo_service.geometry.sequence import Sequence, Stream

from .files import is_rigid, number, pair_by_stamp
from .phone_images import PhoneGrid
from .rig import Rig
from .video import Video

SUFFIX = ".mkv"
DEPTH_SCALE = 1000.0  # Units per meter.
MAX_CALIBRATION_BYTES = 1 << 20  # Maximum size of calibration.json; it has about 10 kB.
# Modes of the depth camera: size of the image, size of the calibrated image at the same resolution,
# and the image's upper left corner in it, in pixels (Azure Kinect Sensor SDK).
DEPTH_MODES = {
    (320, 288): (512, 96, 90),
    (640, 576): (1024, 192, 180),
    (512, 512): (512, 0, 0),
    (1024, 1024): (1024, 0, 0),
}
LOCATION = "CALIBRATION_CameraLocation"


class AzureKinectSequence(Sequence):
    """Azure Kinect recording: each color image gets the nearest depth image within 20 ms."""

    registration = "reader"

    def __init__(self, path: Path) -> None:
        """Open the recording of a file.

        Raises:
            ConfigError: PyAV is not installed.
            DataError: The file cannot be read, or a stream or the calibration is missing.
        """
        self._path = path
        streams, calibration, others = _contents(path)
        missing = [title for title in ("COLOR", "DEPTH") if title not in streams]
        if missing or calibration is None:
            found = ", ".join(streams) or "none"
            raise DataError(
                f"{path} has no {missing[0] if missing else 'attachment calibration.json'}; its "
                f"video streams are: {found}. Record color and depth with k4arecorder."
            )
        self._color, self._depth = (Video(path, streams[title]) for title in ("COLOR", "DEPTH"))
        pairs = pair_by_stamp(
            path,
            ("color images", self._color.stamps_ns),
            ("depth images", self._depth.stamps_ns),
            "Record again with synchronized images.",
        )
        self._pairs = pairs
        rig = _rig(calibration, self._color, self._depth, path)
        self._grid = PhoneGrid(rig.color_camera)
        self._rig = Rig(self._grid.camera, rig.depth_camera, rig.T_color_depth)
        super().__init__(path.stem, self._grid.camera, self._color.stamps_ns[pairs[:, 0]])
        self.streams = (
            Stream("COLOR", "video", len(self._color), "color"),
            Stream("DEPTH", "video", len(self._depth), "depth"),
            *others,
        )
        self.depth_offsets_ns = self._depth.stamps_ns[pairs[:, 1]] - self.stamps_ns

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        color, depth = map(int, self._pairs[index])
        image = self._depth.read(depth, "gray16le").astype(np.float32) / DEPTH_SCALE
        depth_m = self._rig.register(image)
        stamp_ns = int(self.stamps_ns[index])
        return self._grid.frame(index, stamp_ns, self._color.read(color), depth_m, 1.0)

    def truth(self) -> Trajectory | None:
        """Return None; the camera measures no poses."""
        return None


def _contents(path: Path) -> tuple[dict[str, int], bytes | None, tuple[Stream, ...]]:
    """Return the numbers of the video streams by title, the calibration, and unused streams.

    The calibration is None if the file has none.

    Raises:
        ConfigError: PyAV is not installed.
        DataError: The file cannot be read.
    """
    try:
        import av  # The library is optional.
        from av.error import FFmpegError
    except ImportError as error:
        raise ConfigError(
            f"{path} is a recording of an Azure Kinect, which needs the extra `phones`. Install it "
            f"by {install_command('phones')}."
        ) from error
    try:
        with av.open(str(path)) as container:
            streams = {_title(s, k): k for k, s in enumerate(container.streams.video)}
            others = tuple(
                Stream(_title(s, k), s.type, None, "")
                for k, s in enumerate(container.streams)
                if s.type != "attachment" and _title(s, k) not in ("COLOR", "DEPTH")
            )
            attached = [
                stream.data
                for stream in container.streams.attachments
                if str(stream.name).endswith("calibration.json")
            ]
    except (FFmpegError, ValueError, AttributeError) as error:
        raise DataError(
            f"{path} cannot be read as a video ({type(error).__name__}: {error}). It may be "
            "truncated. Copy the recording again."
        ) from error
    return streams, bytes(attached[0] or b"") if attached else None, others


def _title(stream: Any, number: int) -> str:
    return str(stream.metadata.get("title", f"without title {number}")).upper()


def _rig(calibration: bytes, color: Video, depth: Video, path: Path) -> Rig:
    """Return the cameras of the recorded images.

    Raises:
        DataError: The calibration is invalid, or no mode of the camera has images of this size.
    """
    source = Path(f"{path}: calibration.json")
    try:
        content = json.loads(calibration[:MAX_CALIBRATION_BYTES].rstrip(b"\0"))
        cameras = {str(entry["Location"]): entry for entry in _cameras(content)}
        color_fields, depth_fields = cameras[f"{LOCATION}PV0"], cameras[f"{LOCATION}D0"]
        parameters = [
            _parameters(fields["Intrinsics"]["ModelParameters"], source)
            for fields in (color_fields, depth_fields)
        ]
        T_color_depth, T_depth_depth = map(_transform, (color_fields, depth_fields))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(
            f"{source} does not have the expected values ({type(error).__name__}: {error}). Copy "
            "the recording again."
        ) from error
    try:
        cameras_of_images = (
            _color_camera(parameters[0], color.width, color.height),
            _depth_camera(parameters[1], depth.width, depth.height),
        )
    except DataError as error:
        raise DataError(f"{source} does not fit the images: {error}") from error
    return Rig(*cameras_of_images, T_color_depth @ se3.inverse(T_depth_depth))


def _cameras(content: Any) -> list[Any]:
    cameras = content["CalibrationInformation"]["Cameras"]
    if not isinstance(cameras, list):
        raise TypeError("`CalibrationInformation.Cameras` must be a list")
    return cameras


def _parameters(values: Any, source: Path) -> list[float]:
    """Return the 14 numbers of an intrinsic calibration.

    Raises:
        DataError: A value is not a finite number.
        TypeError: `values` is not a list of 14 items.
    """
    if not isinstance(values, list) or len(values) != 14:
        raise TypeError("`ModelParameters` must be a list of 14 numbers")
    fields = {f"ModelParameters[{k}]": value for k, value in enumerate(values)}
    return [number(fields, key, source) for key in fields]


def _transform(fields: Any) -> np.ndarray:
    """Return the transform [4, 4] from the depth camera.

    Raises:
        ValueError: The numbers are not a rigid transform.
    """
    T = np.eye(4)
    T[:3, :3] = np.array(fields["Rt"]["Rotation"], float).reshape(3, 3)
    T[:3, 3] = np.array(fields["Rt"]["Translation"], float).reshape(3)
    if not is_rigid(T):
        raise ValueError(f"`Rt` must be a rigid transform, but is {T.tolist()}")
    return se3.orthonormalize(T)


def _color_camera(parameters: list[float], width: int, height: int) -> Camera:
    """Return the camera of color images.

    The calibrated image has the aspect ratio 4:3. Images of 16:9 are its middle rows.
    """
    whole = width * 3 / 4
    return _camera(parameters, (width, whole), (0, (whole - height) / 2), (width, height))


def _depth_camera(parameters: list[float], width: int, height: int) -> Camera:
    """Return the camera of depth images.

    Raises:
        DataError: No mode of the depth camera has images of this size.
    """
    if (width, height) not in DEPTH_MODES:
        sizes = ", ".join(f"{w}x{h}" for w, h in DEPTH_MODES)
        raise DataError(
            f"depth has {width}x{height} pixels, expected one of {sizes}. Record in a depth mode "
            "of the Azure Kinect."
        )
    whole, left, top = DEPTH_MODES[width, height]
    return _camera(parameters, (whole, whole), (left, top), (width, height))


def _camera(
    parameters: list[float],
    whole: tuple[float, float],
    corner: tuple[float, float],
    size: tuple[int, int],
) -> Camera:
    """Return the camera of a part of the calibrated image.

    Args:
        parameters: The 14 numbers of the calibration.
        whole: Width and height of the calibrated image, pixels.
        corner: Upper left corner of the part, pixels.
        size: Width and height of the part, pixels.

    Raises:
        DataError: The intrinsics are implausible.
    """
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = parameters
    return Camera(
        *size,
        fx * whole[0],
        fy * whole[1],
        cx * whole[0] - corner[0] - 0.5,
        cy * whole[1] - corner[1] - 0.5,
        (k1, k2, p1, p2, k3, k4, k5, k6),
    )
