"""Small data sets on disk, in the layouts under test."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT = 24, 16
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": 20.0, "fy": 21.0, "cx": 11.5, "cy": 7.5}
PARAMS = {"w": WIDTH, "h": HEIGHT, "fx": 20.0, "fy": 21.0, "cx": 11.5, "cy": 7.5, "scale": 6553.5}


def _color_image(k: int, size: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    """Return an RGB image with the frame number in red."""
    image = np.zeros((*size, 3), np.uint8)
    image[..., 0], image[..., 2] = (10 * k + 5) % 256, 200
    return image


def _write_color(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1])


def _write_depth(path: Path, value: int, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full(size, value, np.uint16))


def _write_tum(
    folder: Path,
    color_stamps: list[str],
    depth_stamps: list[str],
    camera: dict | None = CAMERA,
    size: tuple[int, int] = (HEIGHT, WIDTH),
) -> Path:
    """Write a TUM folder; color k has red 10 k + 5, and depth k is 1000 (k + 1)."""
    for k, stamp in enumerate(color_stamps):
        _write_color(folder / f"rgb/{stamp}.png", _color_image(k, size))
    for k, stamp in enumerate(depth_stamps):
        _write_depth(folder / f"depth/{stamp}.png", 1000 * (k + 1), size)
    folder.mkdir(parents=True, exist_ok=True)
    for name, stamps in (("rgb", color_stamps), ("depth", depth_stamps)):
        lines = [f"{stamp} {name}/{stamp}.png" for stamp in stamps]
        (folder / f"{name}.txt").write_text("\n".join(["# stamp file", *lines, ""]))
    if camera is not None:
        (folder / "camera.json").write_text(json.dumps(camera))
    return folder


def _write_replica(folder: Path, numbers: list[int], params: dict | None = PARAMS) -> Path:
    """Write a Replica folder, and cam_params.json to its parent.

    Depth k is 1000 (k + 1), and frame k is at x = k m.
    """
    for k in numbers:
        _write_color(folder / f"results/frame{k:06d}.jpg", _color_image(k))
        _write_depth(folder / f"results/depth{k:06d}.png", 1000 * (k + 1))
    (folder / "results").mkdir(parents=True, exist_ok=True)
    rows = []
    for k in range(max(numbers, default=-1) + 1):
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = k
        rows.append(" ".join(map(str, T_world_camera.ravel())))
    (folder / "traj.txt").write_text("\n".join(rows) + "\n")
    if params is not None:
        (folder.parent / "cam_params.json").write_text(json.dumps({"camera": params}))
    return folder


def _write_matrix(path: Path, matrix: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(" ".join(map(str, row)) for row in matrix.tolist()) + "\n")


def _pose(k: int) -> np.ndarray:
    T_world_camera = np.eye(4)
    T_world_camera[0, 3] = k
    return T_world_camera


def _intrinsics(fx: float, fy: float, cx: float, cy: float, size: int) -> np.ndarray:
    K = np.eye(size)
    K[[0, 1, 0, 1], [0, 1, 2, 2]] = fx, fy, cx, cy
    return K


def _write_scannet(
    folder: Path, numbers: list[int], T_sensor_depth: np.ndarray | None = None
) -> Path:
    """Write a ScanNet folder with color of twice the size of depth.

    Depth k is 1000 (k + 1), and frame k is at x = k m.
    """
    for k in numbers:
        _write_color(folder / f"color/{k}.jpg", _color_image(k, (2 * HEIGHT, 2 * WIDTH)))
        _write_depth(folder / f"depth/{k}.png", 1000 * (k + 1))
        _write_matrix(folder / f"pose/{k}.txt", _pose(k))
    color, depth = (40.0, 42.0, 23.5, 15.5), (20.0, 21.0, 11.5, 7.5)
    _write_matrix(folder / "intrinsic/intrinsic_color.txt", _intrinsics(*color, 4))
    _write_matrix(folder / "intrinsic/intrinsic_depth.txt", _intrinsics(*depth, 4))
    _write_matrix(folder / "intrinsic/extrinsic_color.txt", np.eye(4))
    T = np.eye(4) if T_sensor_depth is None else T_sensor_depth
    _write_matrix(folder / "intrinsic/extrinsic_depth.txt", T)
    return folder


def _write_seven_scenes(folder: Path, numbers: list[int], suffix: str = "png") -> Path:
    """Write a 7-Scenes folder without intrinsics, in 640x480.

    Depth k is 1000 (k + 1), and frame k is at x = k m.
    """
    for k in numbers:
        name = f"frame-{k:06d}"
        _write_color(folder / f"{name}.color.{suffix}", _color_image(k, (480, 640)))
        _write_depth(folder / f"{name}.depth.png", 1000 * (k + 1), (480, 640))
        _write_matrix(folder / f"{name}.pose.txt", _pose(k))
    return folder


@pytest.fixture
def scannet_folder(tmp_path: Path) -> Callable[..., Path]:
    """Return a writer; call it with frame numbers and, optionally, T_sensor_depth."""
    return partial(_write_scannet, tmp_path / "scene0000_00")


@pytest.fixture
def seven_scenes_folder(tmp_path: Path) -> Callable[..., Path]:
    """Return a writer; call it with frame numbers and, optionally, the suffix of color."""
    return partial(_write_seven_scenes, tmp_path / "seq-01")


@pytest.fixture
def write_matrix() -> Callable[..., None]:
    return _write_matrix


@pytest.fixture
def write_tum() -> Callable[..., Path]:
    return _write_tum


@pytest.fixture
def write_replica() -> Callable[..., Path]:
    return _write_replica


@pytest.fixture
def tum_folder(tmp_path: Path) -> Callable[..., Path]:
    """Return a writer; call it with color and depth stamps and, optionally, camera and size."""
    return partial(_write_tum, tmp_path / "desk")


@pytest.fixture
def replica_folder(tmp_path: Path) -> Callable[..., Path]:
    """Return a writer; call it with frame numbers and, optionally, camera parameters."""
    return partial(_write_replica, tmp_path / "office0")
