"""Sequences in the layout of nerfstudio, as Polycam and `ns-process-data` export them.

transforms.json      JSON with these keys:
    fl_x fl_y cx cy [w h] [k1 k2 p1 p2 k3]   intrinsics of all frames; a frame may have its own
    frames                                   list of frames with the keys file_path (color),
                                             depth_file_path, and transform_matrix (from camera to
                                             world, camera axes of OpenGL)
    camera_model                             optional, see CAMERA_MODELS
    depth_unit_scale_factor                  optional: meters per unit of depth, default 0.001
images/ depth/       image files; depth has any size, and the same field of view as color

In transforms.json, the principal point is measured from the corner of the image. In this project,
it is measured from the center of the first pixel. The frames have no stamps, so frame k of the list
gets the stamp k / 30 s. The poses come from COLMAP or from a phone. They are an estimate, not
ground truth, so `odometry` returns them and `truth` returns None.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import Sequence

from .files import (
    FRAME_RATE_HZ,
    Calibration,
    from_opengl,
    inside,
    name_of,
    number,
    pinhole,
    read_json,
    valid_trajectory,
)
from .images import first_size, read_color, read_depth
from .phone_images import PhoneGrid, scaled

log = logging.getLogger(__name__)

METERS_PER_UNIT = 0.001  # Default of depth_unit_scale_factor.
CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


class NerfstudioSequence(Sequence):
    """Sequence of nerfstudio: frames with both color and depth, in the order of the file."""

    def __init__(self, folder: Path) -> None:
        """Open the sequence of a folder."""
        path = folder / "transforms.json"
        content = read_json(path)
        found: Any = content.get("frames")
        listed: list[Any] = found if isinstance(found, list) else []
        frames = [frame for frame in listed if _has_depth(frame)]
        if not frames:
            raise DataError(
                f'{path}: expected a list "frames" with a "file_path" and a "depth_file_path" in '
                "its entries. Export the recording again, with depth images."
            )
        if len(frames) < len(listed):
            log.info(
                "%s: skipping %d frames without depth_file_path.",
                *(path, len(listed) - len(frames)),
            )
        self._files = [
            (_file(path, frame["file_path"]), _file(path, frame["depth_file_path"]))
            for frame in frames
        ]
        self._poses = [_pose(frame.get("transform_matrix")) for frame in frames]
        size = first_size([color for color, _ in self._files])
        self._cameras = [_camera({**content, **frame}, size, path) for frame in frames]
        self._grid = PhoneGrid(self._cameras[0])
        factor = {"depth_unit_scale_factor": METERS_PER_UNIT, **content}
        meters = number(factor, "depth_unit_scale_factor", path)
        if meters <= 0:
            raise DataError(
                f'{path}: "depth_unit_scale_factor" is {meters:g}, must be positive. Set it to the '
                "meters per depth unit, such as 0.001."
            )
        self._depth_scale = Calibration(self._grid.camera, 1 / meters).depth_scale
        stamps_ns = np.arange(len(frames), dtype=np.int64) * 10**9 // FRAME_RATE_HZ
        super().__init__(name_of(folder), self._grid.camera, stamps_ns)

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        color, depth = self._files[index]
        return self._grid.frame(
            index,
            int(self.stamps_ns[index]),
            read_color(color),
            read_depth(depth),
            self._depth_scale,
            self._cameras[index],
        )

    def truth(self) -> Trajectory | None:
        """Return None; the poses of transforms.json are an estimate."""
        return None

    def odometry(self) -> Trajectory | None:
        """Return the poses of transforms.json, or None if no frame has a valid pose."""
        return valid_trajectory(self.stamps_ns, self._poses)


def _pose(matrix: Any) -> np.ndarray | None:
    """Convert a matrix of transforms.json to the axes of this project; None if it is not 4x4."""
    try:
        T_world_camera = np.array(matrix, float)
    except (TypeError, ValueError):
        return None
    return from_opengl(T_world_camera) if T_world_camera.shape == (4, 4) else None


def _has_depth(frame: Any) -> bool:
    keys = ("file_path", "depth_file_path")
    return isinstance(frame, dict) and all(isinstance(frame.get(key), str) for key in keys)


def _file(path: Path, name: str) -> Path:
    """Return the path of a file that transforms.json names.

    Raises:
        DataError: The file is outside the folder.
    """
    file = inside(path.parent, name)
    if file is None:
        raise DataError(
            f"{path}: {name[:80]!r} is outside the folder. Copy or link the images into the folder."
        )
    return file


def _camera(fields: dict[str, Any], size: tuple[int, int], path: Path) -> Camera:
    """Return the camera of a frame.

    Args:
        fields: Values of the frame. A value that the frame lacks is the value for all frames.
        size: Width and height of the color images.
        path: File of the values, for errors.

    Raises:
        DataError: A value is missing or invalid, or the camera model is not supported.
    """
    model = fields.get("camera_model", "OPENCV")
    if model not in CAMERA_MODELS:
        raise DataError(
            f"{path}: camera_model is {model!r}, expected one of {', '.join(CAMERA_MODELS)}. "
            "Undistort the images, or export them with one of these models."
        )
    k1, k2, p1, p2, k3, k4 = (
        number({key: 0.0, **fields}, key, path) for key in ("k1", "k2", "p1", "p2", "k3", "k4")
    )
    if k4:
        raise DataError(
            f"{path}: k4 is {k4:g}, but only k1, k2, k3, p1 and p2 are supported. Undistort the "
            "images."
        )
    distortion = [k1, k2, p1, p2, k3] if k3 else [k1, k2, p1, p2]
    fx = number(fields, "fl_x", path)
    values = {
        "w": size[0],
        "h": size[1],
        **fields,
        "fx": fx,
        "fy": number({"fl_y": fx, **fields}, "fl_y", path),
        "cx": number(fields, "cx", path) - 0.5,
        "cy": number(fields, "cy", path) - 0.5,
        "distortion": distortion if any(distortion) else [],
    }
    return scaled(pinhole(values, "w", "h", path), *size, str(path))
