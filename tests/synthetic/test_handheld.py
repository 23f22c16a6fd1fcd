"""Simulator of a hand-held camera: each effect alone, and all of them together."""

import hashlib
from dataclasses import fields

import cv2
import numpy as np
import pytest

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import Camera, se3
from ldo_service.synthetic import open_synthetic
from ldo_service.synthetic.handheld import (
    ALL,
    NAMED,
    Effects,
    HandheldConfig,
    HandheldSequence,
)
from ldo_service.synthetic.handheld.color_sensor import (
    TARGET,
    automatic_gains,
    exposure_motion_px,
    projected_px,
    vignetting,
)
from ldo_service.synthetic.handheld.depth_sensors import DepthBias, measure
from ldo_service.synthetic.handheld.effects import parse_effects
from ldo_service.synthetic.handheld.sequence import DISTORTION, EXPOSURE_S, FOCAL_PX
from ldo_service.synthetic.optics import undistorted

FRAME = 75  # A frame of the tour in a fast turn.
BYTES = {
    "room-handheld": "9e0762a0b6ac9a73",
    "tour-handheld:all+tof@1": "f43497b63976f224",
    "flat-handheld:all+stereo@2": "98b901347dd11c2f",
}


@pytest.fixture(autouse=True)
def folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LDO_CACHE", str(tmp_path_factory.getbasetemp() / "handheld"))


def sequence(name: str) -> HandheldSequence:
    opened = open_synthetic(name)
    assert isinstance(opened, HandheldSequence)
    return opened


def world_points(seq: HandheldSequence, depth_m: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return the world points [H, W, 3] of a depth image with one pose per row."""
    points = seq.camera.rays() * depth_m[..., None]
    return np.einsum("hij,hwj->hwi", poses[:, :3, :3], points) + poses[:, None, :3, 3]


@pytest.mark.parametrize("name", BYTES)
def test_bytes_are_equal_on_every_machine(name: str) -> None:
    frame = sequence(name).read(40)
    digest = hashlib.blake2b(frame.color.tobytes() + frame.depth.tobytes(), digest_size=8)
    assert digest.hexdigest() == BYTES[name]


def test_no_effect_records_the_exact_images_at_the_true_pose() -> None:
    seq = sequence("tour-handheld:none")
    frame, truth = seq.read(FRAME), seq.truth().T_world_camera[FRAME]
    exact = seq.exact(FRAME, truth)
    np.testing.assert_array_equal(frame.depth, exact.depth_m.astype(np.float32))
    np.testing.assert_array_equal(frame.color, np.floor(exact.light * 255 + 0.5))
    assert seq.raw_camera.distortion == ()


def test_rows_of_a_rolling_shutter_lie_on_the_floor_with_their_own_pose_only() -> None:
    seq = sequence("tour-handheld:rolling-shutter")
    poses, depth_m = seq.row_poses(FRAME), seq.read(FRAME).depth.astype(float)
    middle = np.broadcast_to(seq.truth().T_world_camera[FRAME], poses.shape)
    by_row, by_frame = world_points(seq, depth_m, poses), world_points(seq, depth_m, middle)
    is_floor = np.abs(by_row[..., 2]) < 1e-5
    assert is_floor.mean() > 0.02
    assert np.abs(by_frame[is_floor][:, 2]).min() > 1e-4


def test_late_depth_is_exact_at_its_own_time() -> None:
    seq = sequence("tour-handheld:late-depth")
    assert 0.01 <= seq.depth_delay_s <= 0.02
    frame, later = seq.read(FRAME), seq.depth_row_poses(FRAME)
    np.testing.assert_array_equal(frame.depth, seq.exact(FRAME, later).depth_m.astype(np.float32))
    own = sequence("tour-handheld:none").read(FRAME)
    np.testing.assert_array_equal(frame.color, own.color)
    assert np.median(np.abs(own.depth - frame.depth)) > 1e-3


def test_blur_length_is_the_rotation_during_the_exposure() -> None:
    seq = sequence("tour-handheld:blur")
    rows = seq.exposure_rows(FRAME)
    far_m = np.full((480, 640), 1e6)  # Far surfaces are moved by rotation alone.
    du, dv = exposure_motion_px(far_m, seq.raw_camera, rows)
    turned_rad = se3.rotation_angle(se3.inverse(rows.opened[0]) @ rows.closed[0])
    assert np.hypot(du, dv)[240, 320] == pytest.approx(turned_rad * FOCAL_PX, rel=0.05)
    assert turned_rad > np.deg2rad(60) * EXPOSURE_S
    sharp, recorded = sequence("tour-handheld:none").read(FRAME), seq.read(FRAME)
    across = np.abs(np.diff(sharp.color.astype(float), axis=1)).mean()
    assert np.abs(np.diff(recorded.color.astype(float), axis=1)).mean() < 0.8 * across


def test_rays_through_a_lens_are_those_of_opencv() -> None:
    camera = Camera(640, 480, FOCAL_PX, FOCAL_PX, 319.5, 239.5, DISTORTION)
    u, v = np.meshgrid(np.arange(0, 640.0, 7), np.arange(0, 480.0, 7))
    x, y = undistorted(camera, u.ravel(), v.ravel())
    rays, zero = np.stack([x, y, np.ones(x.shape)], -1), np.zeros(3)
    pixels, _ = cv2.projectPoints(rays, zero, zero, camera.matrix, np.array(DISTORTION))
    np.testing.assert_allclose(pixels[:, 0], np.stack([u.ravel(), v.ravel()], -1), atol=1e-4)


def test_rectified_image_through_a_lens_is_that_of_a_pinhole() -> None:
    bent, plain = sequence("tour-handheld:distortion")[FRAME], sequence("tour-handheld:none")[FRAME]
    inside = np.s_[30:-30, 30:-30]
    difference = np.abs(bent.color[inside].astype(float) - plain.color[inside])
    assert np.median(difference) <= 1
    raw = sequence("tour-handheld:distortion").read(FRAME).color[inside]
    assert difference.mean() < 0.5 * np.abs(raw.astype(float) - plain.color[inside]).mean()


def test_corners_are_dark_and_the_center_is_not() -> None:
    factor = vignetting(sequence("tour-handheld").raw_camera)
    np.testing.assert_allclose(factor[240, 320], 1, atol=1e-4)
    np.testing.assert_allclose(factor[0, 0, 1], 0.65, atol=0.01)
    np.testing.assert_allclose(factor[240, 0, 1], 0.735, atol=0.01)
    assert factor[0, 0, 0] < factor[0, 0, 1] < factor[0, 0, 2]


def test_exposure_follows_the_scene_with_a_delay() -> None:
    bright, dark = np.full((12, 3), 0.8), np.full((12, 3), 0.2)
    settled = automatic_gains(dark)
    np.testing.assert_allclose(settled * 0.2, TARGET)
    just_after = automatic_gains(np.concatenate([bright, dark[:1]]))
    assert TARGET / 0.8 < just_after[1] < settled[1]
    red = automatic_gains(np.tile([0.6, 0.4, 0.2], (200, 1)))
    assert red[0] < red[1] < red[2]


@pytest.mark.parametrize("sensor", ["kinect", "tof", "stereo"])
def test_depth_noise_grows_with_depth(sensor: str) -> None:
    light = np.full((200, 200, 3), 0.5)

    def spread_m(depth_m: float) -> float:
        rng = np.random.default_rng(0)
        measured = measure(sensor, np.full((200, 200), depth_m), light, FOCAL_PX, rng)
        return float(np.std(measured[measured > 0]))

    assert 0.0005 < spread_m(1.0) < 0.01
    assert spread_m(3.0) > 2 * spread_m(1.0)


def test_flying_pixels_lie_between_the_surfaces_of_an_edge() -> None:
    exact_m = np.where(np.arange(200) < 100, 1.0, 3.0) * np.ones((200, 1))
    light, rng = np.full((200, 200, 3), 0.5), np.random.default_rng(0)
    between = (measured := measure("tof", exact_m, light, FOCAL_PX, rng)) > 1.2
    between &= measured < 2.8
    columns = np.flatnonzero(between.any(axis=0))
    assert set(columns) <= {98, 99, 100, 101}
    assert between.sum() > 50


def test_near_surface_of_stereo_covers_the_far_one() -> None:
    exact_m = np.where(np.arange(200) < 100, 1.0, 3.0) * np.ones((200, 1))
    light, rng = np.full((200, 200, 3), 0.5), np.random.default_rng(0)
    measured = measure("stereo", exact_m, light, FOCAL_PX, rng)
    near = np.median(np.where(measured > 0, measured, 9.0), axis=0) < 1.5
    assert near[101]
    assert not near[104]


def test_bias_adds_a_polynomial_to_inverse_depth() -> None:
    camera, bias = sequence("room-handheld").raw_camera, DepthBias(-0.017, -0.018, 0.01)
    depth_m = np.full((480, 640), 3.0)
    biased = bias.biased(depth_m, camera)
    side = 1 / biased[240, 639] - 1 / 3.0
    assert side == pytest.approx(-0.017, rel=0.02)
    assert biased[240, 320] == pytest.approx(3.0, abs=1e-3)
    assert (bias.biased(np.zeros((480, 640)), camera) == 0).all()
    assert DepthBias.of_seed(1) != DepthBias.of_seed(2)


@pytest.mark.parametrize("name", NAMED)
def test_motion_is_as_hard_as_stated(name: str) -> None:
    """95th percentiles: 60 deg/s, 8 px of row skew, 5 px of blur, 5 px between depth and color."""
    seq = sequence(name)
    T = seq.truth().T_world_camera
    step_s = float(np.diff(seq.stamps_ns).mean()) / 1e9
    turns = se3.rotation_angles(se3.inverse(T[:-1]) @ T[1:]) / step_s
    assert np.percentile(np.rad2deg(turns), 95) >= 60
    depth_m, camera = np.full((480, 640), 2.0), seq.raw_camera
    moved: dict[str, list[float]] = {"skew": [], "blur": [], "late": []}
    for index in range(0, len(seq), len(seq) // 6):
        rows = seq.row_poses(index)
        first, last = (np.broadcast_to(rows[i], rows.shape) for i in (0, -1))
        start, end = (
            projected_px(depth_m, camera, first, first),
            projected_px(depth_m, camera, first, last),
        )
        moved["skew"].append(float(np.median(np.hypot(end[0] - start[0], end[1] - start[1]))))
        du, dv = exposure_motion_px(depth_m, camera, seq.exposure_rows(index))
        moved["blur"].append(float(np.median(np.hypot(du, dv))))
        own = projected_px(depth_m, camera, rows, rows)
        late = projected_px(depth_m, camera, rows, seq.depth_row_poses(index))
        moved["late"].append(float(np.median(np.hypot(late[0] - own[0], late[1] - own[1]))))
    limits = {"skew": 8.0, "blur": 5.0, "late": 5.0}
    assert all(np.percentile(moved[key], 95) >= limit for key, limit in limits.items())


def test_labels_are_those_of_the_rectified_image_at_the_true_pose() -> None:
    bent, plain = (
        sequence(f"flat-handheld:{one}") for one in ("distortion+rolling-shutter", "none")
    )
    labels = [one.true_labels() for one in (bent, plain)]
    assert labels[0] is not None
    assert labels[1] is not None
    one, other = (label.frame(FRAME) for label in labels)
    np.testing.assert_array_equal(one.class_ids, other.class_ids)
    np.testing.assert_array_equal(one.instance_ids, other.instance_ids)
    assert len(np.unique(one.instance_ids)) > 5
    assert sequence("tour-handheld").true_labels() is None


@pytest.mark.parametrize("change", [{"walk": "garden"}, {"seed": -1}])
def test_invalid_config_is_rejected(change: dict) -> None:
    with pytest.raises(ConfigError):
        HandheldConfig(**change)


def test_names_choose_effects() -> None:
    assert parse_effects("", "x") == ALL
    assert parse_effects(":none", "x") == Effects()
    assert parse_effects(":blur+tof", "x") == Effects(blur=True, depth="tof")
    stereo = parse_effects(":all+stereo", "x")
    assert stereo.depth == "stereo"
    assert all(getattr(stereo, f.name) for f in fields(Effects))
    assert sequence("tour-handheld:blur@3").config.seed == 3


@pytest.mark.parametrize("name", ["tour-handheld:fog", "garden-handheld", "tour-handheldx"])
def test_unknown_name_is_refused_with_the_known_ones(name: str) -> None:
    with pytest.raises(DataError, match="Choose"):
        open_synthetic(name)
