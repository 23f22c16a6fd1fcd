"""Sequences of the KITTI odometry benchmark (Geiger et al., CVPR 2012), one folder each.

image_2/*.png image_3/*.png   rectified images of the left and the right color camera; if they are
                              missing, image_0/ and image_1/ of the gray cameras
calib.txt                     lines of `P2: 12 numbers`: the matrix, by rows, that projects points
                              in coordinates of rectified camera 0 to the images of camera 2
times.txt                     seconds, one line per image
poses.txt                     optional: 12 numbers per image, the first three rows of the transform
                              from camera 0 to world. If this file is missing, the file of the
                              benchmark is read: ../../poses/NAME.txt, NAME being the folder's name

The benchmark has no depth images. Depth is computed from each stereo pair by semi-global matching
of OpenCV. The depth is the z coordinate in the left camera. The ground truth is the pose of this
camera.
"""

from dataclasses import dataclass
from pathlib import Path
from threading import local

import cv2
import numpy as np

from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import Camera, RawFrame, Trajectory, se3
from ldo_service.geometry.sequence import Sequence

from .files import is_rigid, name_of, numbered, pair_by_number, parse_stamp
from .images import first_size, read_color

PAIRS = ("image_2", "image_3"), ("image_0", "image_1")  # Color cameras, gray cameras.
# Maximum disparity as a fraction of the width. At the size of KITTI it is 128 pixels, and the
# nearest depth is 3 m; the nearest road in its images is at 4 to 6 m.
MAX_DISPARITY_RATIO = 0.1
# Disparity below which depth is left out. The error of disparity is 0.24 px rms on stereo images of
# synthetic:room and synthetic:tour, so depth is wrong by 5 % there. At KITTI, this is 77 m.
MIN_DISPARITY_PX = 5.0
BLOCK_PX = 5  # Side of the matched windows; smaller ones are noisier, larger ones blur edges.


@dataclass(frozen=True, slots=True)
class _Stereo:
    """Calibration of a rectified stereo pair."""

    camera: Camera  # Left camera.
    baseline_m: float
    T_camera0_camera: np.ndarray  # [4, 4], left camera to camera 0.


class KittiSequence(Sequence):
    """KITTI sequence: frames with a left and a right image, in the order of their numbers."""

    registration = "reader"

    def __init__(self, folder: Path) -> None:
        """Open the sequence of a folder."""
        self._folder = folder
        names = next(pair for pair in PAIRS if (folder / pair[0]).is_dir())
        left, right = (numbered(folder / name, r"(\d+)\.png") for name in names)
        if not left.keys() & right.keys():
            raise DataError(
                f"{folder} has {len(left)} images in {names[0]}/ and {len(right)} in {names[1]}/, "
                "but no number occurs in both. Download both folders of the benchmark."
            )
        self._files = pair_by_number(left, right, folder)
        first, second = (int(name[-1]) for name in names)
        self._stereo = _calibration(folder / "calib.txt", first, second, self._files.color)
        times_ns = _times_ns(folder / "times.txt")
        last = int(self._files.numbers[-1])
        if last >= len(times_ns):
            raise DataError(
                f"{folder / 'times.txt'} has {len(times_ns)} lines, expected at least {last + 1}, "
                f"because the last image has the number {last}. Download the file again."
            )
        super().__init__(name_of(folder), self._stereo.camera, times_ns[self._files.numbers])
        self._matchers = local()  # One per thread, because a matcher has buffers.

    @staticmethod
    def matches(folder: Path) -> bool:
        """Return whether a folder has this layout."""
        has_images = any((folder / left).is_dir() for left, _ in PAIRS)
        return has_images and (folder / "calib.txt").is_file()

    def read(self, index: int) -> RawFrame:
        """Return a frame; see `Sequence.read`."""
        left, right = read_color(self._files.color[index]), read_color(self._files.depth[index])
        if left.shape != right.shape:
            raise FrameError(
                f"{self._files.color[index]} is {left.shape[1]}x{left.shape[0]} pixels and "
                f"{self._files.depth[index]} {right.shape[1]}x{right.shape[0]}, expected equal "
                "sizes. Download them again."
            )
        disparity_px = self._match(left, right)
        stereo = self._stereo
        is_known = disparity_px >= MIN_DISPARITY_PX
        depth_m = np.zeros(disparity_px.shape, np.float32)
        np.divide(stereo.camera.fx * stereo.baseline_m, disparity_px, out=depth_m, where=is_known)
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, left, depth_m, 1.0, self.raw_camera)

    def truth(self) -> Trajectory | None:
        """Return the ground-truth trajectory of the left camera; None without a poses file."""
        folder = self._folder.resolve()
        paths = folder / "poses.txt", folder.parent.parent / "poses" / f"{folder.name}.txt"
        path = next((path for path in paths if path.is_file()), None)
        if path is None:
            return None
        poses = _poses(path)
        numbers = self._files.numbers
        if numbers[-1] >= len(poses):
            raise DataError(
                f"{path} has {len(poses)} lines, expected at least {numbers[-1] + 1}, because the "
                f"last image has the number {numbers[-1]}. Download the file again."
            )
        T_world_camera = poses[numbers] @ self._stereo.T_camera0_camera
        return Trajectory(self.stamps_ns / 1e9, T_world_camera)

    def _match(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Return the disparity of the left image, [H, W] float32 pixels; negative where unknown."""
        width = left.shape[1]
        if not hasattr(self._matchers, "matcher"):
            self._matchers.matcher = cv2.StereoSGBM.create(
                minDisparity=0,
                numDisparities=max(1, round(MAX_DISPARITY_RATIO * width / 16)) * 16,
                blockSize=BLOCK_PX,
                P1=8 * BLOCK_PX**2,  # Recommended by OpenCV, for one channel.
                P2=32 * BLOCK_PX**2,
                disp12MaxDiff=1,
                uniquenessRatio=10,
                speckleWindowSize=100,
                speckleRange=2,
                mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
            )
        gray = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
        return self._matchers.matcher.compute(*gray).astype(np.float32) / 16


def _calibration(path: Path, left: int, right: int, images: list[Path]) -> _Stereo:
    """Read the calibration of two cameras from calib.txt.

    Raises:
        DataError: The file cannot be read, or the cameras are not a rectified stereo pair.
    """
    matrices = dict(_matrices(path))
    missing = [f"P{k}" for k in (left, right) if f"P{k}" not in matrices]
    if missing:
        raise DataError(
            f"{path} has no line `{missing[0]}: 12 numbers`. Download the calibration of the "
            "odometry benchmark."
        )
    P, P_right = matrices[f"P{left}"], matrices[f"P{right}"]
    K, size = P[:, :3], first_size(images)
    try:
        fx, fy, cx, cy = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        camera = Camera(*size, fx, fy, cx, cy)
        T_camera_camera0 = np.eye(4)
        T_camera_camera0[:3, 3] = np.linalg.solve(K, P[:, 3])
        baseline_m = float(P[0, 3] - P_right[0, 3]) / camera.fx
    except DataError as error:
        raise DataError(f"{path} has invalid intrinsics in line P{left}: {error}") from error
    except np.linalg.LinAlgError as error:
        raise DataError(
            f"{path} has a singular intrinsic matrix in line P{left}. Download the file again."
        ) from error
    if not (baseline_m > 0 and np.allclose(K, P_right[:, :3], rtol=1e-3, atol=1e-3)):
        raise DataError(
            f"{path}: P{left} and P{right} are not the cameras of a rectified pair. Their baseline "
            f"is {baseline_m:g} m and must be positive, and their intrinsics must be equal. "
            "Download the file again."
        )
    return _Stereo(camera, baseline_m, se3.inverse(T_camera_camera0))


def _matrices(path: Path) -> list[tuple[str, np.ndarray]]:
    """Return the matrices [3, 4] of calib.txt with their names; other lines are skipped."""
    found = []
    for line in _lines(path):
        name, _, numbers = line.partition(":")
        values = _row(numbers)
        if values is not None:
            found.append((name.strip(), values))
    return found


def _times_ns(path: Path) -> np.ndarray:
    """Return the ascending stamps of times.txt, [N] int64.

    Raises:
        DataError: The file cannot be read, a line is invalid, or the times do not ascend.
    """
    times_ns: list[int] = []
    for number, line in enumerate(_lines(path), 1):
        try:
            times_ns.append(parse_stamp(line))
        except ValueError:
            raise DataError(
                f"{path}, line {number}: expected a time in seconds, found {line[:80]!r}. "
                "Download the file again."
            ) from None
        if len(times_ns) > 1 and times_ns[-1] <= times_ns[-2]:
            raise DataError(
                f"{path}, line {number}: the time {line.strip()} s is not later than the time in "
                "the previous line. Download the file again."
            )
    return np.array(times_ns, np.int64)


def _poses(path: Path) -> np.ndarray:
    """Return the poses of camera 0, [N, 4, 4].

    Raises:
        DataError: The file cannot be read, or a line is invalid.
    """
    poses = []
    for number, line in enumerate(_lines(path), 1):
        values, T = _row(line), np.eye(4)
        if values is not None:
            T[:3] = values
        if values is None or not is_rigid(T):
            raise DataError(
                f"{path}, line {number}: expected 12 numbers, the first three rows of a rigid "
                f"transform, found {line[:80]!r}. Download the file again."
            )
        poses.append(se3.orthonormalize(T))
    return np.array(poses).reshape(-1, 4, 4)


def _row(text: str) -> np.ndarray | None:
    """Parse a line of 12 numbers as a matrix [3, 4]; return None if it is not 12 finite numbers."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        return None
    is_valid = len(values) == 12 and bool(np.isfinite(values).all())
    return values.reshape(3, 4) if is_valid else None


def _lines(path: Path) -> list[str]:
    try:
        return [line for line in path.read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read: {error}. Download it again.") from error
