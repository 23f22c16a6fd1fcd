from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.finished_run import Exposures, FinishedRun, PosedMap
from ldo_service.evaluation.views import (
    EvaluatedFrames,
    RenderingErrors,
    ViewErrors,
    evaluate_rendering,
    evaluate_view,
    exposure_fitted,
    map_as_it_is,
    measured_pixels,
    view_of,
)
from ldo_service.geometry import RgbdFrame, Trajectory, se3
from ldo_service.runs.finished import read_run

A, FITTED, PLAIN = "A held out", "A held out, exposure fitted", "A held out, no exposure"
B = "B training"


@pytest.fixture(scope="module")
def sequence(room_folder: Path) -> Sequence:
    return open_sequence(str(room_folder))


@pytest.fixture(scope="module")
def run(finished_run: Path) -> FinishedRun:
    return read_run(finished_run)


def evaluate(
    sequence: Sequence, run: FinishedRun, *maps: PosedMap
) -> dict[tuple[str, str], RenderingErrors]:
    evaluated = EvaluatedFrames.of(run.frames)
    rows = evaluate_rendering(sequence, evaluated, maps or run.maps, lambda _done: None)
    return {(row.map, row.protocol): row for row in rows}


def moved(posed: PosedMap, distance_m: float) -> PosedMap:
    T_new_old = se3.exp(np.array([0, 0, 0, distance_m, 0, 0]))
    poses = posed.trajectory.T_world_camera @ T_new_old
    return replace(posed, name="moved", trajectory=Trajectory(posed.trajectory.stamps_s, poses))


def test_each_protocol_evaluates_its_frames(sequence: Sequence, run: FinishedRun) -> None:
    rows = evaluate(sequence, run)
    assert list(rows) == [("online", protocol) for protocol in (A, FITTED, PLAIN, B)]
    frames = {protocol: [v.frame for v in row.views] for (_, protocol), row in rows.items()}
    assert frames == {A: [4, 9, 14], FITTED: [4, 9, 14], PLAIN: [4, 9, 14], B: [0, 6, 12]}
    for row in rows.values():
        assert row.mean("psnr_db") > 25
        assert row.mean("ssim") > 0.8
        assert row.mean("depth_l1_m") < 0.05
        assert row.mean("depth_share") > 0.95
        assert row.mean("lpips") is None


def test_wrong_pose_worsens_every_measure(sequence: Sequence, run: FinishedRun) -> None:
    rows = evaluate(sequence, run, run.maps[0], moved(run.maps[0], 0.02))
    for protocol in (A, FITTED, B):
        right, wrong = rows["online", protocol], rows["moved", protocol]
        assert wrong.mean("psnr_db") < right.mean("psnr_db") - 3
        assert wrong.mean("ssim") < right.mean("ssim") - 0.02
        assert wrong.mean("depth_l1_m") > right.mean("depth_l1_m")


def test_lost_frame_is_counted_and_not_evaluated(sequence: Sequence, run: FinishedRun) -> None:
    status = {9: "LOST", 6: "LOST", 4: "WEAK"}
    frames = tuple(replace(f, status=status.get(f.index, f.status)) for f in run.frames)
    rows = evaluate(sequence, replace(run, frames=frames))
    assert [view.frame for view in rows["online", A].views] == [4, 14]
    assert [view.frame for view in rows["online", B].views] == [0, 12]
    assert EvaluatedFrames.of(frames).counts() == (
        "A: 2 of 3 frames, 1 LOST, 1 WEAK. B: 2 of 3 frames, 1 LOST, 0 WEAK."
    )


def test_counts_without_held_out_frames_name_the_option(
    sequence: Sequence, run: FinishedRun
) -> None:
    frames = tuple(replace(frame, is_held_out=False) for frame in run.frames)
    rows = evaluate(sequence, replace(run, frames=frames))
    assert list(rows) == [("online", B)]
    assert [view.frame for view in rows["online", B].views] == [0, 5, 10, 15]
    assert "--hold-out-every 5" in EvaluatedFrames.of(frames).counts()


def test_darker_image_lowers_psnr_unless_exposure_is_fitted(
    sequence: Sequence, run: FinishedRun
) -> None:
    posed, frame = run.maps[0], sequence[4]
    dark = replace(frame, color=(frame.color * 0.6 + 20).astype(np.uint8))
    as_seen, darkened = (
        dict(evaluate_view(view_of(image, posed, run.frame(4)), True)) for image in (frame, dark)
    )
    assert darkened[A].psnr_db < as_seen[A].psnr_db - 3
    assert darkened[FITTED].psnr_db > as_seen[FITTED].psnr_db
    assert as_seen[FITTED].psnr_db >= as_seen[A].psnr_db
    assert darkened[FITTED].depth_l1_m == as_seen[A].depth_l1_m


def test_exposure_is_interpolated_between_neighboring_keyframes(
    sequence: Sequence, run: FinishedRun
) -> None:
    """The frame is midway between keyframes 1 s apart, one of them twice as bright as the map."""
    stamp_ns = run.frame(4).stamp_ns
    matrices = np.array([np.full((2, 3), 2.0), np.full((2, 3), 1.0)]) * [[1], [0]]
    exposures = Exposures(stamp_ns + np.array([-500_000_000, 500_000_000]), matrices)
    view = view_of(sequence[4], replace(run.maps[0], exposures=exposures), run.frame(4))
    _, plain = map_as_it_is(view)
    np.testing.assert_allclose(view.shown, (1.5 * plain).clip(0, 1), atol=1e-6)
    assert exposures.at(stamp_ns - 10**9).gain[0] == 2
    assert exposures.at(stamp_ns + 10**12).gain[0] == 1


def test_exposure_fit_changes_the_rendering_and_not_the_camera_image(
    sequence: Sequence, run: FinishedRun
) -> None:
    view = view_of(sequence[4], run.maps[0], run.frame(4))
    seen, shown = exposure_fitted(view)
    np.testing.assert_array_equal(seen, view.seen)
    np.testing.assert_allclose(shown.mean(axis=(0, 1)), seen.mean(axis=(0, 1)), atol=0.005)


def test_pixels_without_depth_are_black_in_both_images(
    sequence: Sequence, run: FinishedRun
) -> None:
    frame = sequence[6]
    depth_m = frame.depth_m.copy()
    depth_m[:, :100] = 0
    holed = RgbdFrame(frame.color, depth_m, frame.camera, frame.stamp_ns, frame.index)
    view = view_of(holed, run.maps[0], run.frame(6))
    for image, whole in zip(measured_pixels(view), (view.seen, view.shown), strict=True):
        assert not image[:, :100].any()
        np.testing.assert_array_equal(image[depth_m > 0], whole[depth_m > 0])


def test_lpips_receives_the_images_of_each_protocol(sequence: Sequence, run: FinishedRun) -> None:
    received = []

    def distance(a: np.ndarray, b: np.ndarray) -> float:
        received.append((a, b))
        return float(len(received))

    view = view_of(sequence[4], run.maps[0], run.frame(4))
    errors = dict(evaluate_view(view, True, distance))
    assert [errors[A].lpips, errors[FITTED].lpips, errors[PLAIN].lpips] == [1, 2, 3]
    np.testing.assert_array_equal(received[0], (view.seen, view.shown))
    np.testing.assert_array_equal(received[1], exposure_fitted(view))


def test_frames_without_a_measure_are_excluded_from_its_mean() -> None:
    views = tuple(
        ViewErrors(frame, psnr_db, 0.5, None, depth_l1_m, 0.0)
        for frame, psnr_db, depth_l1_m in ((1, 20.0, np.nan), (2, 30.0, 0.02), (3, 31.0, 0.04))
    )
    row = RenderingErrors("online", A, views)
    assert row.mean("psnr_db") == 27
    assert row.median("psnr_db") == 30
    assert row.mean("depth_l1_m") == pytest.approx(0.03)
    assert row.median("lpips") is None


def test_black_rim_of_rectification_changes_no_score(sequence: Sequence, run: FinishedRun) -> None:
    """The frame has a rim that no map renders, as one that rectification leaves black."""
    frame = run.frame(4)
    image, valid = sequence[4], np.zeros(sequence[4].depth_m.shape, bool)
    valid[12:-12, 12:-12] = True
    rimmed = replace(image, color=image.color * valid[..., None])
    plain = view_of(image, run.maps[0], frame, valid=valid)
    view = view_of(rimmed, run.maps[0], frame, valid=valid)
    assert view.psnr_db == plain.psnr_db
    without_mask = view_of(rimmed, run.maps[0], frame)
    assert without_mask.psnr_db < view.psnr_db - 5
    for (protocol, errors), (_, expected) in zip(
        evaluate_view(view, True), evaluate_view(plain, True), strict=True
    ):
        assert errors.psnr_db == pytest.approx(expected.psnr_db), protocol
        assert errors.ssim == pytest.approx(expected.ssim), protocol
