from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.tracking import (
    AlignConfig,
    Alignment,
    PyramidConfig,
    align,
    build_reference,
    pyramid_of,
)

XI = np.array([0.01, -0.03, 0.02, 0.05, -0.03, 0.04])  # 2.1 degrees and 7 cm.
T_REFERENCE_CAMERA = se3.exp(XI)


def aligned(reference: RgbdFrame, frame: RgbdFrame, guess: np.ndarray | None = None) -> Alignment:
    return align(
        build_reference(pyramid_of(reference, PyramidConfig())),
        pyramid_of(frame, PyramidConfig()),
        np.eye(4) if guess is None else guess,
        AlignConfig(),
    )


def errors(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the errors of T in meters and degrees."""
    difference = se3.inverse(truth) @ T
    return float(np.linalg.norm(difference[:3, 3])), np.degrees(se3.rotation_angle(difference))


def assert_close(T: np.ndarray, truth: np.ndarray) -> None:
    translation_m, rotation_deg = errors(T, truth)
    assert translation_m < 1e-3
    assert rotation_deg < 0.05


@pytest.mark.parametrize("size", [(160, 120), (161, 121), (128, 128), (320, 240)])
def test_known_motion_is_found(make_room, size: tuple[int, int]) -> None:
    room = make_room(*size)
    result = aligned(room.view(np.eye(4)), room.view(T_REFERENCE_CAMERA))
    assert_close(result.T_reference_camera, T_REFERENCE_CAMERA)
    assert result.converged
    assert result.overlap > 0.8
    assert result.condition < 1e4


def test_thumbnail_of_80_by_60_pixels_is_aligned_to_five_millimeters(make_room) -> None:
    room = make_room(80, 60)
    result = aligned(room.view(np.eye(4)), room.view(T_REFERENCE_CAMERA))
    assert errors(result.T_reference_camera, T_REFERENCE_CAMERA)[0] < 5e-3


def test_exposure_change_is_estimated_and_does_not_move_the_pose(room) -> None:
    dimmed = room.view(T_REFERENCE_CAMERA, gain=0.8, bias=12.0)
    result = aligned(room.view(np.eye(4)), dimmed)
    assert_close(result.T_reference_camera, T_REFERENCE_CAMERA)
    assert result.gain == pytest.approx(0.8, abs=0.02)
    assert result.bias == pytest.approx(12.0, abs=3.0)


@pytest.mark.parametrize("gain", [0.4, 2.0])
def test_exposure_that_clips_a_third_of_the_image_does_not_move_the_pose(room, gain) -> None:
    frame = room.view(T_REFERENCE_CAMERA, gain=gain)
    assert gain < 1 or np.mean(frame.color[..., 0] == 255) > 0.3
    result = aligned(room.view(np.eye(4)), frame)
    assert_close(result.T_reference_camera, T_REFERENCE_CAMERA)
    assert result.gain == pytest.approx(gain, rel=0.03)


def test_color_alone_aligns_a_frame_without_depth(room) -> None:
    view = room.view(T_REFERENCE_CAMERA)
    result = aligned(room.view(np.eye(4)), replace(view, depth_m=np.zeros_like(view.depth_m)))
    assert_close(result.T_reference_camera, T_REFERENCE_CAMERA)
    assert result.paired == 0


def wall(T_wall_camera: np.ndarray, camera: Camera, is_textured: bool) -> RgbdFrame:
    """Return a view of the plane z = 2 m of the frame `wall`."""
    T = T_wall_camera.copy()
    T[2, 3] -= 2.0
    rays = camera.rays() @ T[:3, :3].T
    depth_m = -T[2, 3] / rays[..., 2]
    x, y, _ = np.moveaxis(T[:3, 3] + rays * depth_m[..., None], -1, 0)
    pattern = 50 * np.sin(9 * x + 4 * y) + 40 * np.sin(11 * y - 3 * x) + 25 * np.sin(21 * x)
    gray = np.rint(128 + is_textured * pattern).astype(np.uint8)
    return RgbdFrame(np.repeat(gray[..., None], 3, 2), depth_m.astype(np.float32), camera)


def test_texture_constrains_motion_within_a_plane(room) -> None:
    views = [wall(T, room.camera, is_textured=True) for T in (np.eye(4), T_REFERENCE_CAMERA)]
    assert_close(aligned(*views).T_reference_camera, T_REFERENCE_CAMERA)


def test_information_of_a_plain_wall_is_rotation_first_and_singular(room) -> None:
    result = aligned(*[wall(np.eye(4), room.camera, is_textured=False)] * 2)
    information = np.diag(result.information)
    is_constrained = information > 1e-6 * information.max()
    np.testing.assert_array_equal(is_constrained, [True, True, False, False, False, True])
    assert result.condition > 1e5


def test_close_initial_guess_takes_fewer_iterations(room) -> None:
    views = room.view(np.eye(4)), room.view(T_REFERENCE_CAMERA)
    informed = aligned(*views, se3.inverse(T_REFERENCE_CAMERA))
    assert informed.iterations < aligned(*views).iterations


def test_blank_frame_gives_a_finite_pose_without_pairs(room) -> None:
    for pair in ((room.blank(), room.view(np.eye(4))), (room.view(np.eye(4)), room.blank())):
        result = aligned(*pair)
        assert np.isfinite(result.T_reference_camera).all()
        assert result.paired == 0


def test_depth_noise_raises_its_scale_and_lowers_the_information(room) -> None:
    rng = np.random.default_rng(3)
    view = room.view(T_REFERENCE_CAMERA)
    noisy = replace(
        view, depth_m=(view.depth_m + rng.normal(0, 0.01, view.depth_m.shape)).astype(np.float32)
    )
    clean, rough = aligned(room.view(np.eye(4)), view), aligned(room.view(np.eye(4)), noisy)
    assert rough.depth_noise_scale > 2 * clean.depth_noise_scale
    assert rough.information.trace() < clean.information.trace()
    assert errors(rough.T_reference_camera, T_REFERENCE_CAMERA)[0] < 3e-3


def test_results_are_bitwise_reproducible(room) -> None:
    first, second = (aligned(room.view(np.eye(4)), room.view(T_REFERENCE_CAMERA)) for _ in range(2))
    assert first.T_reference_camera.tobytes() == second.T_reference_camera.tobytes()
    assert first.information.tobytes() == second.information.tobytes()


def test_settings_without_iterations_are_rejected() -> None:
    with pytest.raises(ConfigError, match="iterations"):
        AlignConfig(iterations=())
