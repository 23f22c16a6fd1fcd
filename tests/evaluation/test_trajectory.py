"""Trajectory errors, compared with evo."""

import copy
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

from ldo_service.datasets import open_sequence
from ldo_service.errors import DataError
from ldo_service.evaluation import (
    ErrorStatistics,
    TrajectoryErrors,
    evaluate_trajectory,
    fit_rigid_transform,
)
from ldo_service.geometry import Trajectory, se3
from ldo_service.tracking import Odometry


def random_trajectory(seed: int, count: int = 150) -> Trajectory:
    rng = np.random.default_rng(seed)
    T, poses = se3.exp(rng.normal(0, 1, 6)), []
    for _ in range(count):
        T = T @ se3.exp(rng.normal(0, 0.03, 6))
        poses.append(T)
    return Trajectory(100 + np.arange(count) / 30, np.array(poses))


def disturbed(truth: Trajectory, seed: int, sigma: float = 0.01) -> Trajectory:
    """Return the truth in another world frame, with drift, and with stamps off by milliseconds."""
    rng = np.random.default_rng(seed)
    T_other_world = se3.exp(rng.normal(0, 1, 6))
    errors = np.cumsum(rng.normal(0, sigma, (len(truth), 6)), axis=0)
    poses = [
        T_other_world @ T @ se3.exp(xi) for T, xi in zip(truth.T_world_camera, errors, strict=True)
    ]
    return Trajectory(truth.stamps_s + rng.uniform(-0.004, 0.004, len(truth)), np.array(poses))


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        poses_se3=list(trajectory.T_world_camera), timestamps=trajectory.stamps_s
    )


def with_gaps(trajectory: Trajectory, seed: int, kept_ratio: float = 0.8) -> Trajectory:
    """Remove single poses, and 12 in a row."""
    kept = np.random.default_rng(seed).random(len(trajectory)) < kept_ratio
    kept[40 + seed : 52 + seed] = False
    return Trajectory(trajectory.stamps_s[kept], trajectory.T_world_camera[kept])


def shifted(trajectory: Trajectory, offset_s: float) -> Trajectory:
    return Trajectory(trajectory.stamps_s + offset_s, trajectory.T_world_camera)


def evo_errors(
    estimate: PoseTrajectory3D, truth: PoseTrajectory3D, delta: int
) -> list[dict[str, float]]:
    reference, other = sync.associate_trajectories(truth, estimate, max_diff=0.02)
    aligned = copy.deepcopy(other)
    aligned.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, aligned))
    results = [ape.get_all_statistics()]
    for relation in (
        metrics.PoseRelation.translation_part,
        metrics.PoseRelation.rotation_angle_deg,
    ):
        rpe = metrics.RPE(relation, delta, metrics.Unit.frames, all_pairs=True)
        rpe.process_data((reference, other))
        results.append(rpe.get_all_statistics())
    return results


def assert_evo_agrees(estimate: Trajectory, truth: Trajectory) -> None:
    ours = evaluate_trajectory(estimate, truth)
    theirs = evo_errors(as_evo(estimate), as_evo(truth), ours.rpe_poses)
    assert_equal(ours, theirs)


def assert_equal(ours: TrajectoryErrors, theirs: list[dict[str, float]]) -> None:
    for mine, expected in zip(
        (ours.ate_m, ours.rpe_translation_m, ours.rpe_rotation_deg), theirs, strict=True
    ):
        assert mine is not None
        for name in ("rmse", "mean", "median", "max"):
            assert getattr(mine, name) == pytest.approx(expected[name], abs=1e-6), name


@pytest.mark.parametrize("seed", range(4))
def test_errors_agree_with_evo(seed: int) -> None:
    truth = random_trajectory(seed)
    assert_evo_agrees(disturbed(truth, seed), truth)


@pytest.mark.parametrize("seed", range(4))
def test_errors_agree_with_evo_when_poses_are_missing(seed: int) -> None:
    truth = random_trajectory(seed)
    estimate = disturbed(truth, seed)
    for poses in ((with_gaps(estimate, seed), truth), (estimate, with_gaps(truth, seed))):
        assert_evo_agrees(*poses)
    assert_evo_agrees(with_gaps(estimate, seed), with_gaps(truth, seed + 9))


@pytest.mark.parametrize("offset_s", [-0.009, 0.004, 0.009])
def test_errors_agree_with_evo_when_clocks_differ(offset_s: float) -> None:
    truth = random_trajectory(5)
    late = shifted(with_gaps(disturbed(truth, 5), 5), offset_s)
    assert_evo_agrees(late, with_gaps(truth, 6))


def test_errors_agree_with_evo_when_the_truth_is_denser() -> None:
    truth = random_trajectory(8, count=500)
    truth = Trajectory(100 + np.arange(500) / 100, truth.T_world_camera)
    estimate = disturbed(truth, 8, sigma=0.003)
    thin = Trajectory(estimate.stamps_s[1::3], estimate.T_world_camera[1::3])
    assert_evo_agrees(with_gaps(thin, 8), truth)


def test_errors_of_unsorted_files_agree_with_evo_on_sorted_ones(tmp_path: Path) -> None:
    truth = random_trajectory(9)
    sorted_files, shuffled_files = [], []
    for name, trajectory in (("estimate", disturbed(truth, 9)), ("truth", truth)):
        sorted_files.append(tmp_path / f"{name}.txt")
        trajectory.save(sorted_files[-1])
        lines = sorted_files[-1].read_text().splitlines()
        np.random.default_rng(9).shuffle(lines)
        shuffled_files.append(tmp_path / f"{name}-shuffled.txt")
        shuffled_files[-1].write_text("# stamp tx ty tz qx qy qz qw\n" + "\n".join(lines))
    ours = evaluate_trajectory(*(Trajectory.load(file) for file in shuffled_files))
    sorted_trajectories = (file_interface.read_tum_trajectory_file(file) for file in sorted_files)
    assert_equal(ours, evo_errors(*sorted_trajectories, ours.rpe_poses))


def test_each_pose_is_used_once_where_evo_may_use_one_twice() -> None:
    """Two late poses have the same nearest true pose, because one true pose is missing."""
    truth = random_trajectory(3, count=60)
    late = shifted(truth, 0.015)
    with_missing_pose = Trajectory(
        np.delete(truth.stamps_s, 30), np.delete(truth.T_world_camera, 30, 0)
    )
    fewer = Trajectory(late.stamps_s[10:50], late.T_world_camera[10:50])
    ours = evaluate_trajectory(fewer, with_missing_pose)
    _, theirs = sync.associate_trajectories(as_evo(with_missing_pose), as_evo(fewer), max_diff=0.02)
    assert (ours.poses, theirs.num_poses) == (39, 40)


def test_errors_agree_with_evo_on_a_real_trajectory(data: Path) -> None:
    truth = open_sequence(str(data / "tum/kitchen")).truth()
    assert truth is not None
    assert_evo_agrees(disturbed(truth, 1, sigma=0.002), truth)


def test_errors_agree_with_evo_on_a_tracked_trajectory(data: Path) -> None:
    kitchen, odometry = open_sequence(str(data / "tum/kitchen")), Odometry()
    indices = range(0, 160, 4)
    poses = [odometry.process(kitchen[index]).T_odom_camera for index in indices]
    truth = kitchen.truth()
    assert truth is not None
    assert_evo_agrees(Trajectory(kitchen.stamps_ns[indices] * 1e-9, np.array(poses)), truth)


def test_another_world_frame_adds_no_error() -> None:
    truth = random_trajectory(1)
    T_other_world = se3.exp(np.array([1.0, -2, 0.5, 3, 2, 1]))
    errors = evaluate_trajectory(
        Trajectory(truth.stamps_s, T_other_world @ truth.T_world_camera), truth
    )
    assert errors.ate_m.max < 1e-12
    assert errors.rpe_translation_m is not None
    assert errors.rpe_translation_m.max < 1e-12
    np.testing.assert_allclose(errors.T_truth_estimate @ T_other_world, np.eye(4), atol=1e-12)


def test_scale_is_not_aligned_away() -> None:
    truth = random_trajectory(2)
    doubled = truth.T_world_camera.copy()
    doubled[:, :3, 3] *= 2
    assert evaluate_trajectory(Trajectory(truth.stamps_s, doubled), truth).ate_m.rmse > 0.05


def test_mirrored_points_are_not_aligned_by_a_reflection() -> None:
    points = np.random.default_rng(3).normal(size=(30, 3))
    T = fit_rigid_transform(points, points * [1, 1, -1])
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_points_on_a_line_still_align() -> None:
    points = np.outer(np.arange(10.0), [1, 2, 3])
    target = se3.transform(se3.exp(np.array([0.3, 0.2, 0.1, 1, 2, 3])), points)
    np.testing.assert_allclose(
        se3.transform(fit_rigid_transform(points, target), points), target, atol=1e-12
    )


def test_static_camera_has_an_error_of_zero() -> None:
    poses = np.tile(np.eye(4), (50, 1, 1))
    still = Trajectory(np.arange(50) / 30, poses)
    assert evaluate_trajectory(still, still).ate_m.max == 0


def test_short_trajectories_have_no_relative_error() -> None:
    truth = random_trajectory(4, count=20)
    errors = evaluate_trajectory(truth, truth)
    assert (errors.poses, errors.rpe_poses) == (20, 30)
    assert errors.rpe_translation_m is None
    assert errors.rpe_rotation_deg is None


def test_too_few_pairs_are_a_data_error_with_both_time_ranges() -> None:
    truth = random_trajectory(5)
    late = Trajectory(truth.stamps_s + 1000, truth.T_world_camera)
    with pytest.raises(DataError, match=r"0 of 150.*1100\.000 s.*100\.000 s.*same clock"):
        evaluate_trajectory(late, truth)
    empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    with pytest.raises(DataError, match="spans nothing"):
        evaluate_trajectory(empty, truth)


def test_statistics_are_rmse_mean_median_and_max() -> None:
    assert ErrorStatistics.of(np.array([3.0, 4, 0, 1])) == ErrorStatistics(
        np.sqrt(26 / 4), 2.0, 2.0, 4.0
    )
