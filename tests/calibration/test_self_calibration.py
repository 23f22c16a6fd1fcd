"""Self-calibration on exact frames to which a known vignetting and depth bias are added."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.calibration.correction import (
    CameraCorrection,
    CorrectionChange,
    read_correction,
    unbiased_depth,
)
from ldo_service.calibration.estimation import estimate
from ldo_service.calibration.self_calibration import (
    SelfCalibration,
    SelfCalibrationConfig,
)
from ldo_service.calibration.shutter import ShutterTiming
from ldo_service.calibration.views import ViewMaker, pair_of, reprojection
from ldo_service.datasets import Sequence
from ldo_service.errors import DataError
from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.storage.state_codec import decode_state, encode_state

# Sizes of a PrimeSense camera: 70 to 210 mm at the sides, 3 m away, and corners at 0.65.
TRUE = CameraCorrection(
    (-0.017, -0.012, 0.008), ((-0.74, 0.47, -0.16), (-0.72, 0.44, -0.14), (-0.5, 0.2, -0.05))
)
COUNT = 60  # Frames.
CONFIG = SelfCalibrationConfig(views=(6, 10))


def measured(frame: RgbdFrame, truth: CameraCorrection) -> RgbdFrame:
    """Return an exact frame as a camera with this vignetting and bias would measure it."""
    camera = frame.camera
    depth_m = unbiased_depth(frame.depth_m, -truth.bias(camera))
    gain = truth.gain(camera)
    V = gain.min(axis=(0, 1)) / gain
    color = (frame.color * V + 0.5).astype(np.uint8)
    return replace(frame, color=color, depth_m=depth_m)


@pytest.fixture(scope="module")
def frames(room: Sequence) -> list[RgbdFrame]:
    return [room[index] for index in range(COUNT)]


def poses(room: Sequence) -> list[np.ndarray]:
    truth = room.truth()
    assert truth is not None
    return list(truth.T_world_camera[:COUNT])


def changes_of(
    calibration: SelfCalibration, frames: list[RgbdFrame], moved: list[np.ndarray]
) -> list[CorrectionChange]:
    made = [calibration.observe(*both) for both in zip(frames, moved, strict=True)]
    return [change for change in made if change is not None]


def test_known_bias_and_vignetting_are_found(room: Sequence, frames: list[RgbdFrame]) -> None:
    calibration = SelfCalibration()
    changes = changes_of(calibration, [measured(f, TRUE) for f in frames], poses(room))
    found, camera = calibration.correction, frames[0].camera
    assert changes[-1].new == found
    # The rows are less certain than the columns, because the camera mostly yaws.
    error = found.bias(camera) - TRUE.bias(camera)
    assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean(TRUE.bias(camera) ** 2))
    np.testing.assert_allclose(found.gain(camera), TRUE.gain(camera), atol=0.06)
    # The error of the bias is plausible for its covariance.
    sigma = np.sqrt(np.diag(calibration.depth_bias_covariance))
    assert (sigma > 0).all()
    assert (abs(np.subtract(found.depth_bias, TRUE.depth_bias)) < 4 * sigma).all()
    assert (sigma < 0.5 * np.abs(TRUE.depth_bias)).all()


def test_exact_camera_gets_no_correction(room: Sequence, frames: list[RgbdFrame]) -> None:
    calibration = SelfCalibration()
    assert changes_of(calibration, frames, poses(room)) == []
    assert calibration.correction == CameraCorrection()
    assert calibration.metrics()["depth_bias_corrected"] == 0


def test_finished_calibration_drops_its_views(room: Sequence, frames: list[RgbdFrame]) -> None:
    calibration = SelfCalibration(CONFIG)
    changes_of(calibration, [measured(f, TRUE) for f in frames], poses(room))
    assert calibration.is_finished
    assert set(calibration.snapshot()) == {"now", "maker"}
    assert calibration.correction.has_vignetting


def test_camera_that_stands_still_is_not_calibrated(frames: list[RgbdFrame]) -> None:
    calibration = SelfCalibration()
    still = np.eye(4)
    assert changes_of(calibration, [measured(frames[0], TRUE)] * 20, [still] * 20) == []
    assert calibration.metrics()["calibration_views"] == 1


@pytest.mark.parametrize("split", [3, 12, 17, 25, 40])
def test_restored_calibration_continues_bitwise_equal(
    room: Sequence, frames: list[RgbdFrame], split: int
) -> None:
    biased, moved = [measured(f, TRUE) for f in frames], poses(room)
    first, second = SelfCalibration(CONFIG), SelfCalibration(CONFIG)
    changes_of(first, biased[:split], moved[:split])
    second.restore(decode_state(encode_state(first.snapshot())))
    rest = biased[split:], moved[split:]
    assert changes_of(first, *rest) == changes_of(second, *rest)
    assert encode_state(first.snapshot()) == encode_state(second.snapshot())


def test_estimate_that_runs_over_several_frames_is_restored_bitwise_equal(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    biased, moved = [measured(f, TRUE) for f in frames], poses(room)
    first, second = SelfCalibration(CONFIG), SelfCalibration(CONFIG)
    split = 0
    while first.snapshot()["now"]["steps_done"] < 20:
        assert first.observe(biased[split], moved[split]) is None
        split += 1
    second.restore(decode_state(encode_state(first.snapshot())))
    rest = biased[split:], moved[split:]
    changes = changes_of(first, *rest)
    assert changes
    assert changes == changes_of(second, *rest)
    assert encode_state(first.snapshot()) == encode_state(second.snapshot())


def test_running_estimate_of_an_earlier_version_starts_again(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    biased, moved = [measured(f, TRUE) for f in frames], poses(room)
    first, second = SelfCalibration(CONFIG), SelfCalibration(CONFIG)
    split = 0
    while not first.snapshot()["now"]["is_running"]:
        first.observe(biased[split], moved[split])
        split += 1
    state = decode_state(encode_state(first.snapshot()))
    del state["now"]["steps_done"]  # The earlier version had other steps, and no times.
    del state["now"]["last_times_s"], state["now"]["timing_equations"], state["now"]["new_view"]
    second.restore(state)
    assert changes_of(second, biased[split:], moved[split:])


def test_no_step_of_an_estimate_does_more_than_a_frames_work(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    maker = ViewMaker()
    chosen = zip(frames[::6], poses(room)[::6], strict=True)
    views = {n: maker.make(measured(f, TRUE), T) for n, (f, T) in enumerate(chosen)}
    pairs = [pair_of(views[n], views[n + 1]) for n in range(len(views) - 1)]
    used = [p for p in pairs if p is not None]
    steps = estimate(views, used, np.zeros(3), np.zeros(3), np.zeros((3, 3)))
    work = list(steps)
    assert 0 < max(work) <= 1
    assert sum(work) > len(views)


def test_pair_from_the_poses_of_the_tracker_equals_that_of_ransac(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    truth, shift = poses(room), se3.exp(np.array([0.01, 0.005, 0.0, 0.02, 0.0, 0.01]))
    maker, lost = ViewMaker(), ViewMaker()
    wrong = [truth[0], truth[4] @ shift]
    views = [maker.make(f, T) for f, T in zip((frames[0], frames[4]), wrong, strict=True)]
    with_pose = pair_of(*views)
    without_pose = pair_of(*(lost.make(frame) for frame in (frames[0], frames[4])))
    T_true = se3.inverse(truth[4]) @ truth[0]
    for pair in (with_pose, without_pose):
        assert pair is not None
        np.testing.assert_allclose(pair.T_second_first, T_true, atol=0.01)


def test_reprojection_derivatives_equal_finite_differences() -> None:
    camera = Camera(640, 480, 520.0, 525.0, 320.0, 240.0)
    points = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 1.5]])
    pixels, T = np.zeros((2, 2)), se3.exp(np.array([0.1, -0.2, 0.05, 0.1, 0.0, 0.2]))
    errors, by_point, moved = reprojection(camera, T, points, pixels)
    np.testing.assert_allclose(errors, camera.project(moved))
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-7
        changed, _, _ = reprojection(camera, se3.exp(step) @ T, points, pixels)
        np.testing.assert_allclose(
            (changed - errors) / 1e-7, by_point[..., axis], rtol=1e-4, atol=1e-2
        )


def test_correction_removes_what_the_camera_added(frames: list[RgbdFrame]) -> None:
    exact = frames[0]
    corrected = TRUE.applied(measured(exact, TRUE))
    np.testing.assert_allclose(corrected.depth_m, exact.depth_m, rtol=1e-5)
    V = TRUE.gain(exact.camera).min(axis=(0, 1))
    np.testing.assert_allclose(corrected.color, exact.color * V, atol=1.5)
    assert CameraCorrection().applied(exact) is exact


def test_unmeasured_depth_stays_unmeasured(frames: list[RgbdFrame]) -> None:
    depth_m = frames[0].depth_m.copy()
    depth_m[:10] = 0.0
    corrected = TRUE.applied(replace(frames[0], depth_m=depth_m))
    assert np.array_equal(corrected.depth_m == 0, depth_m == 0)


def test_changed_correction_equals_a_new_one(frames: list[RgbdFrame]) -> None:
    frame, camera = frames[0], frames[0].camera
    half = CameraCorrection(tuple(0.5 * b for b in TRUE.depth_bias))
    old, new = half.applied(frame), TRUE.applied(frame)
    change = CorrectionChange(half, TRUE)
    np.testing.assert_allclose(change.depth_m(old.depth_m, camera), new.depth_m, rtol=1e-5)
    u, v = np.array([20.0, 100.0]), np.array([30.0, 100.0])
    z_old, z_new = old.depth_m[[30, 100], [20, 100]], new.depth_m[[30, 100], [20, 100]]
    points = change.points(camera.points_at(u, v, z_old), camera)
    np.testing.assert_allclose(points, camera.points_at(u, v, z_new), rtol=1e-5)


def test_clipped_pixels_are_kept_for_tracking_and_darkened_for_the_map(
    frames: list[RgbdFrame],
) -> None:
    color = frames[0].color.copy()
    color[100:110, 100:110] = 255
    frame = replace(frames[0], color=color)
    assert (TRUE.applied(frame).color[100:110, 100:110] == 255).all()
    mapped = TRUE.applied(frame, keeps_clipped=False).color[100:110, 100:110]
    expected = 255 * TRUE.gain(frame.camera)[100:110, 100:110]
    np.testing.assert_allclose(mapped, expected, atol=1)


def test_a_run_has_the_correction_of_its_last_keyframe(tmp_path: Path) -> None:
    keyframes = [
        {"stamp_ns": 20, "camera_correction": TRUE.pack()},
        {"stamp_ns": 10},
    ]
    (tmp_path / "keyframes.json").write_text(json.dumps(keyframes))
    assert read_correction(tmp_path) == TRUE
    (tmp_path / "keyframes.json").write_text(json.dumps(keyframes[1:]))
    assert read_correction(tmp_path) == CameraCorrection()


def test_damaged_keyframes_are_an_error_of_the_file(tmp_path: Path) -> None:
    (tmp_path / "keyframes.json").write_text('[{"stamp_ns": 1, "camera_correction": 3}]')
    with pytest.raises(DataError, match=r"keyframes\.json does not have the format"):
        read_correction(tmp_path)


def test_calibration_switched_off_keeps_the_correction_of_a_saved_state(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    first, off = SelfCalibration(CONFIG), SelfCalibration(SelfCalibrationConfig(views=()))
    biased, moved = [measured(f, TRUE) for f in frames[:25]], poses(room)[:25]
    assert changes_of(first, biased, moved)
    off.restore(first.snapshot())
    assert off.observe(biased[0], moved[0]) is None
    assert off.correction == first.correction


def test_depth_near_the_camera_and_far_away_is_unchanged_without_a_bias() -> None:
    depth_m = np.array([[0.0, 0.05, 1.0, 20.0]], np.float32)
    np.testing.assert_allclose(unbiased_depth(depth_m, np.zeros((1, 4))), depth_m, rtol=1e-6)


def test_bias_is_undecided_until_the_first_estimate(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    calibration, moved = SelfCalibration(CONFIG), poses(room)
    assert calibration.is_undecided
    undecided = []
    for frame, T in zip(frames, moved, strict=True):
        calibration.observe(frame, T)
        undecided.append(calibration.is_undecided)
    assert undecided[0]
    assert not undecided[-1]
    assert not SelfCalibration(SelfCalibrationConfig(views=())).is_undecided
    restored = SelfCalibration(CONFIG)
    restored.restore(decode_state(encode_state(calibration.snapshot())))
    assert not restored.is_undecided


def test_bias_sigma_falls_from_that_of_an_unknown_camera(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    calibration, moved = SelfCalibration(CONFIG), poses(room)
    assert calibration.knowledge.relative_bias_sigma == 1.0
    assert calibration.knowledge.timing is None
    changes_of(calibration, [measured(frame, TRUE) for frame in frames], moved)
    assert 0.0 < calibration.knowledge.relative_bias_sigma < 0.3
    exact = SelfCalibration(CONFIG)
    changes_of(exact, frames, moved)
    assert exact.knowledge.relative_bias_sigma == 0.0


def test_confirmed_bias_is_kept_until_held_out_views_refute_it(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    seen, moved = [measured(frame, TRUE) for frame in frames], poses(room)
    strict = SelfCalibration(replace(CONFIG, max_depth_ratio=0.0))
    assert not [c for c in changes_of(strict, seen, moved) if c.new.has_depth_bias]
    followed = SelfCalibration(replace(CONFIG, max_depth_ratio=0.0))
    followed.correction = CameraCorrection((-0.01, 0.0, 0.0))
    changes_of(followed, seen, moved)
    assert np.allclose(followed.correction.depth_bias, TRUE.depth_bias, atol=0.003)
    refuted = SelfCalibration(replace(CONFIG, max_depth_ratio=0.0))
    refuted.correction = CameraCorrection((-0.01, 0.0, 0.0))
    changes_of(refuted, frames, moved)
    assert not refuted.correction.has_depth_bias


def test_known_calibration_is_used_from_the_first_frame_on_and_stays_if_it_fits(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    known = replace(TRUE, timing=ShutterTiming(0.02))
    calibration = SelfCalibration.continued(known, CONFIG)
    assert calibration.correction.depth_bias == TRUE.depth_bias
    assert calibration.correction.vignetting == TRUE.vignetting
    assert not calibration.is_undecided
    seen = [measured(frame, TRUE) for frame in frames]
    changes = changes_of(calibration, seen, poses(room))
    assert len(changes) <= 1  # It uses the largest number of views.
    assert np.allclose(calibration.correction.depth_bias, TRUE.depth_bias, atol=0.003)


def test_known_calibration_is_dropped_if_the_camera_has_no_bias(
    room: Sequence, frames: list[RgbdFrame]
) -> None:
    calibration = SelfCalibration.continued(TRUE, CONFIG)
    changes_of(calibration, frames, poses(room))
    assert not calibration.correction.has_depth_bias
