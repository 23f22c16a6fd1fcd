"""Recordings of the app Stray Scanner for iPhones with a LiDAR.

rgb.mp4                  color, often 1920x1440 pixels
depth/000000.png         millimeters, often 256x192 pixels, registered to color; one per frame
confidence/000000.png    optional: 8 bits, 0 to 2; see MIN_CONFIDENCE
camera_matrix.csv        3x3 by rows, for the size of the video
odometry.csv             lines of `timestamp, frame, x, y, z, qx, qy, qz, qw` after a header

The poses of odometry.csv come from ARKit, with the axes of this project: the app turns its cameras
to x right, y down, z forward. They are an estimate, not ground truth, so `odometry` returns them
and `truth` returns None.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ldo_service.errors import DataError
from ldo_service.geometry import Camera, RawFrame, Trajectory, se3
from ldo_service.geometry.sequence import Sequence, Stream

from .files import name_of, numbered, parse_stamp, valid_trajectory
from .images import read_depth, read_labels
from .phone_images import PhoneGrid, without_doubt
from .video import Video

log = logging.getLogger(__name__)

DEPTH_SCALE = 1000.0  # Units per meter.


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """Line of odometry.csv."""

    stamp_ns: int
    T_world_camera: np.ndarray | None  # [4, 4]; None if the numbers are missing or no pose.


class StrayScannerSequence(Sequence):
    """Recording of Stray Scanner: frames with stamp, color and depth."""

    def __init__(self, folder: Path) -> None:
        """Open the recording of a folder."""
        self._video = Video(folder / "rgb.mp4")
        lines = _lines(folder / "odometry.csv")
        depth = numbered(folder / "depth", r"(\d+)\.png")
        self._confidence = numbered(folder / "confidence", r"(\d+)\.png")
        numbers = [k for k in lines if k in depth and k < len(self._video)]
        if not numbers:
            raise DataError(
                f"{folder} has {len(self._video)} color images, {len(depth)} depth images and "
                f"{len(lines)} lines in odometry.csv, but no frame has all three. Export the "
                "recording again, with depth."
            )
        if len(numbers) < max(len(self._video), len(depth), len(lines)):
            log.info("%s: %d frames have color, depth and a stamp.", folder, len(numbers))
        if not self._confidence:
            log.info("%s has no confidence images; all depth is used.", folder)
        self._frames = [(k, depth[k]) for k in numbers]
        self._grid = PhoneGrid(_camera(folder / "camera_matrix.csv", self._video))
        self._poses = [lines[k].T_world_camera for k in numbers]
        stamps = np.array([lines[k].stamp_ns for k in numbers], np.int64)
        super().__init__(name_of(folder), self._grid.camera, stamps)
        self.streams = (
            Stream("rgb.mp4", "video", len(self._video), "color"),
            Stream("depth", "images", len(depth), "depth"),
            Stream("confidence", "images", len(self._confidence), "validity of depth"),
            Stream("odometry.csv", "poses", len(lines), "odometry"),
            *(
                Stream(path.name, "inertial measurements", None, "")
                for path in folder.glob("imu.csv")
            ),
        )

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        number, path = self._frames[index]
        depth = read_depth(path)
        if number in self._confidence:
            confidence = self._confidence[number]
            depth = without_doubt(depth, read_labels(confidence, np.uint8), str(confidence))
        color = self._video.read(number)
        return self._grid.frame(index, int(self.stamps_ns[index]), color, depth, DEPTH_SCALE)

    def truth(self) -> Trajectory | None:
        """Return None; the poses of the phone are an estimate."""
        return None

    def odometry(self) -> Trajectory | None:
        """Return the poses of the phone, or None if no line of odometry.csv has a pose."""
        return valid_trajectory(self.stamps_ns, self._poses)


def _camera(path: Path, video: Video) -> Camera:
    """Read the camera of the video.

    Raises:
        DataError: The file cannot be read, or the intrinsics are implausible.
    """
    try:
        rows = [line.split(",") for line in path.read_text().splitlines() if line.strip()]
        K = np.array([[float(word) for word in row] for row in rows])
    except (OSError, ValueError) as error:
        raise DataError(
            f"{path} cannot be read as a matrix: {error}. Export the recording again."
        ) from error
    if K.shape != (3, 3):
        raise DataError(
            f"{path} has the shape {K.shape}, expected 3 rows of 3 numbers. Export the recording "
            "again."
        )
    fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    try:
        return Camera(video.width, video.height, fx, fy, cx, cy)
    except DataError as error:
        raise DataError(f"{path} has invalid intrinsics: {error}") from error


def _lines(path: Path) -> dict[int, _Line]:
    """Read the stamp and the pose of each frame, by the number of the frame.

    Raises:
        DataError: The file cannot be read, a line is invalid, or the stamps do not ascend.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read: {error}. Export the recording again.") from error
    found: dict[int, _Line] = {}
    last = (-1, -(2**63))
    for line_number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        words = line.split(",")
        try:
            stamp, number = parse_stamp(words[0]), int(words[1])
        except (ValueError, IndexError):
            raise DataError(
                f"{path}, line {line_number}: expected `timestamp, frame, x, y, z, qx, qy, qz, "
                f"qw`, found {line[:80]!r}. Export the recording again."
            ) from None
        if number <= last[0] or stamp <= last[1]:
            raise DataError(
                f"{path}, line {line_number}: frame {number} at {words[0].strip()} s must be later "
                "than the frame before. Export the recording again."
            )
        found[number] = _Line(stamp, _pose(words[2:]))
        last = number, stamp
    return found


def _pose(words: list[str]) -> np.ndarray | None:
    """Return the transform [4, 4] of x, y, z, qx, qy, qz, qw; None if they are not a valid pose."""
    try:
        x, y, z, *imaginary, real = (float(word) for word in words)
        q = np.array([real, *imaginary])
        norm = float(np.linalg.norm(q))
        is_pose = len(q) == 4 and 0.9 < norm < 1.1 and bool(np.isfinite([x, y, z]).all())
        return se3.from_quaternion(np.array([x, y, z]), q / norm) if is_pose else None
    except ValueError:
        return None
