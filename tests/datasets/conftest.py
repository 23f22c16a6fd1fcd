"""Small data sets written to disk in the layouts under test."""

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
    """RGB: red counts frames."""
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
    """Colour k has red 10 k + 5; depth k is 1000 (k + 1)."""
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
    """Depth k is 1000 (k + 1); frame k stands at x = k m; cam_params.json is one folder up."""
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


@pytest.fixture
def write_tum() -> Callable[..., Path]:
    return _write_tum


@pytest.fixture
def write_replica() -> Callable[..., Path]:
    return _write_replica


@pytest.fixture
def tum_folder(tmp_path: Path) -> Callable[..., Path]:
    """Call with colour stamps, depth stamps and, optionally, camera and size."""
    return partial(_write_tum, tmp_path / "desk")


@pytest.fixture
def replica_folder(tmp_path: Path) -> Callable[..., Path]:
    """Call with frame numbers and, optionally, camera parameters."""
    return partial(_write_replica, tmp_path / "office0")
