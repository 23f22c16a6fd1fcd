"""The kitchen in each format of phones and scanners gives the poses of the original."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import RawFrame, Rectifier, Trajectory
from ldo_service.tracking.odometry import Odometry

from .recordings import (
    DEPTH_SIZE,
    write_nerfstudio,
    write_r3d,
    write_sens,
    write_stray,
)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
FRAMES = range(0, 300, 5)
MAX_ATE_RATIO = 1.3  # The bound of ATE / ATE of the original, for lossy formats.


def track(frames: list[RawFrame]) -> tuple[np.ndarray, Counter[str]]:
    """Return the poses [N, 4, 4] and the number of frames per status."""
    odometry, rectify = Odometry(), Rectifier()
    results = [odometry.process(rectify(frame)) for frame in frames]
    return np.array([r.T_odom_camera for r in results]), Counter(str(r.status) for r in results)


def test_kitchen_in_each_format_gives_the_poses_of_the_original(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kitchen = open_sequence(str(data / "tum/kitchen"))
    truth = kitchen.truth()
    assert truth is not None
    frames = [replace(kitchen.read(k), index=i) for i, k in enumerate(FRAMES)]
    stamps_s = np.array([frame.stamp_ns for frame in frames]) / 1e9

    def ate_m(poses: np.ndarray) -> float:
        return evaluate_trajectory(Trajectory(stamps_s, poses), truth).ate_m.rmse

    def tracked(path: Path) -> tuple[np.ndarray, Counter[str]]:
        """Track a converted recording; nerfstudio has no stamps, so it gets those of the frames."""
        sequence = open_sequence(str(path))
        assert len(sequence) == len(frames)
        read = [sequence.read(k) for k in range(len(sequence))]
        if path.is_dir() and (path / "transforms.json").is_file():
            read = [replace(r, stamp_ns=f.stamp_ns) for r, f in zip(read, frames, strict=True)]
        return track(read)

    original, statuses = track(frames)
    rows = [("original", ate_m(original), statuses)]
    lossless = {
        "nerfstudio, PNG": write_nerfstudio(tmp_path / "nerfstudio", frames),
        ".sens, PNG": write_sens(tmp_path / "png.sens", frames, ".png"),
    }
    for name, path in lossless.items():
        poses, statuses = tracked(path)
        rows.append((name, ate_m(poses), statuses))
        assert np.array_equal(poses, original), name
    lossy = {
        ".sens, JPEG": write_sens(tmp_path / "jpeg.sens", frames),
        "nerfstudio, depth 256x192": write_nerfstudio(tmp_path / "small", frames, DEPTH_SIZE),
        "Record3D, depth 256x192": write_r3d(tmp_path / "kitchen.r3d", frames, DEPTH_SIZE),
        "Stray Scanner, video 1920x1440": write_stray(tmp_path / "stray", frames, enlarged=3),
    }
    for name, path in lossy.items():
        poses, statuses = tracked(path)
        rows.append((name, ate_m(poses), statuses))
        assert statuses["LOST"] == 0, name
        assert ate_m(poses) <= MAX_ATE_RATIO * ate_m(original), name
    with capsys.disabled():
        print()
        for name, error_m, statuses in rows:
            ratio = error_m / rows[0][1]
            print(f"{name:32} ATE {100 * error_m:.3f} cm  ratio {ratio:.3f}  {dict(statuses)}")
