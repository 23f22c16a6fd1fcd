"""Poses from point clouds, in a scene without texture."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.tracking import (
    AlignConfig,
    Alignment,
    Odometry,
    OdometryConfig,
    PyramidConfig,
    TrackingStatus,
    align,
    build_reference,
    pyramid_of,
)
from ldo_service.tracking.features import GicpConfig, register_gicp
from ldo_service.tracking.keyframes import KeyframeConfig

# The floor and two walls are in view.
T_WORLD_CORNER = se3.exp(np.array([-0.35, 0.6, 0.0, 0.0, 0.0, 0.0]))
STEP = np.array([0.02, 0.06, 0.01, 0.06, 0.02, 0.04])  # 4 degrees and 7 cm.


def white_view(room, T_corner_camera: np.ndarray, index: int = 0) -> RgbdFrame:
    return room.view(T_WORLD_CORNER @ T_corner_camera, gain=0.0, bias=120.0, index=index)


def error_m(T: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm((se3.inverse(truth) @ T)[:3, 3]))


def align_and_register(room, T_corner_camera: np.ndarray) -> tuple[Alignment, np.ndarray | None]:
    """Return the results of direct alignment and of GICP, both from the identity."""
    reference = build_reference(pyramid_of(white_view(room, np.eye(4)), PyramidConfig()))
    view = pyramid_of(white_view(room, T_corner_camera), PyramidConfig())
    direct = align(reference, view, np.eye(4), AlignConfig())
    return direct, register_gicp(reference, view, np.eye(4), GicpConfig())


@pytest.mark.parametrize("steps", [1, 2, 3, 5])
def test_gicp_finds_a_large_step_in_a_white_corner(large_room, steps: int) -> None:
    _, by_gicp = align_and_register(large_room, se3.exp(steps * STEP))
    assert by_gicp is not None
    assert error_m(by_gicp, se3.exp(steps * STEP)) < 2e-3


def test_direct_alignment_misses_a_large_step_in_a_white_corner(large_room) -> None:
    direct, _ = align_and_register(large_room, se3.exp(2 * STEP))
    assert error_m(direct.T_reference_camera, se3.exp(2 * STEP)) > 0.1


def test_gicp_finds_nothing_without_depth_or_correspondences(large_room) -> None:
    reference = build_reference(pyramid_of(white_view(large_room, np.eye(4)), PyramidConfig()))
    blank = pyramid_of(large_room.blank(), PyramidConfig())
    assert register_gicp(reference, blank, np.eye(4), GicpConfig()) is None
    far = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 50.0]))
    view = pyramid_of(white_view(large_room, np.eye(4)), PyramidConfig())
    assert register_gicp(reference, view, far, GicpConfig()) is None


def test_gicp_of_few_points_gives_no_pose_and_prints_no_warning(
    large_room, capfd: pytest.CaptureFixture[str]
) -> None:
    view = white_view(large_room, np.eye(4))
    depth_m = np.zeros_like(view.depth_m)
    depth_m[40:56, 40:56] = view.depth_m[40:56, 40:56]
    few = pyramid_of(replace(view, depth_m=depth_m), PyramidConfig())
    reference = build_reference(pyramid_of(view, PyramidConfig()))
    assert register_gicp(reference, few, np.eye(4), GicpConfig()) is None
    assert capfd.readouterr().err == ""


def test_gicp_is_bitwise_reproducible(large_room) -> None:
    one, two = (align_and_register(large_room, se3.exp(3 * STEP))[1] for _ in range(2))
    assert one is not None
    assert two is not None
    assert one.tobytes() == two.tobytes()


def track_white_walls(room, poses: Sequence[np.ndarray]) -> list:
    """Track frames against the first one, although the motion from it to each frame is large."""
    odometry = Odometry(
        OdometryConfig(keyframes=KeyframeConfig(mapping_only_ratio=2.0, min_frames=30))
    )
    return [odometry.process(white_view(room, T, index)) for index, T in enumerate(poses)]


def test_odometry_tracks_large_steps_past_white_walls(large_room) -> None:
    truth = [se3.exp(k * STEP) for k in (0, 2, 1, 3)]
    results = track_white_walls(large_room, truth)
    assert [r.status for r in results] == [TrackingStatus.OK] * 4
    assert max(error_m(r.T_odom_camera, T) for r, T in zip(results, truth, strict=True)) < 2e-3
    assert "gicp" in {r.pose_source for r in results}
    assert max(r.hypothesis_spread_rad for r in results) > 0.1, (
        "the spread of the hypotheses is reported"
    )


@pytest.mark.parametrize("wrong", [{"level": -1}, {"spacing": 0.3}, {"min_partners": 0.0}])
def test_impossible_settings_are_rejected(wrong: dict) -> None:
    with pytest.raises(ConfigError):
        GicpConfig(**wrong)
