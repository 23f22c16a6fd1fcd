"""The command `ldo doctor calibration`, judged by the simulated camera."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ldo_service.calibration.correction import CameraCorrection, vignetting_basis
from ldo_service.calibration.outlines import Extrinsics
from ldo_service.calibration.shutter import ShutterTiming
from ldo_service.commands.calibration_report import corner_brightness, depth_errors_mm
from ldo_service.geometry import Camera
from ldo_service.synthetic.handheld.color_sensor import vignetting
from ldo_service.synthetic.handheld.depth_sensors import DepthBias
from tests.commands.test_cli import ldo

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
METRICS = {
    "calibration_finished": 1.0,
    "calibration_views": 0.0,
    "depth_bias_residual_ratio": 0.31,
    "vignetting_residual_ratio": 0.06,
    "readout_ms": 25.7,
    "readout_estimate_ms": 25.8,
    "readout_sigma_ms": 0.4,
    "depth_readout_ms": 25.2,
    "depth_readout_estimate_ms": 25.2,
    "depth_readout_sigma_ms": 1.7,
    "depth_delay_ms": -15.0,
    "depth_delay_estimate_ms": -15.0,
    "depth_delay_sigma_ms": 0.5,
}
EXTRINSICS = Extrinsics(
    np.array([0.002, 0.001, 0.0, 0.001, 0.0, 0.0]), np.diag([4e-6] * 3 + [2.5e-5] * 3)
)
LARGE = CameraCorrection(
    (-0.016, 0.01, -0.01), ((-0.3, -0.1, -0.1),) * 3, ShutterTiming(0.0257, 0.0252, -0.015)
)


def simulated_correction(camera: Camera, seed: int) -> CameraCorrection:
    """Return the correction that fits the simulated camera best."""
    bias = DepthBias.of_seed(seed)
    v, u = np.mgrid[: camera.height, : camera.width]
    basis = vignetting_basis(u, v, camera).reshape(-1, 3)
    log_V = np.log(vignetting(camera)).reshape(-1, 3)
    a = np.linalg.lstsq(basis, log_V, rcond=None)[0]
    coefficients = tuple(tuple(channel) for channel in a.T.tolist())
    return CameraCorrection((-bias.c20_per_m, -bias.c11_per_m, -bias.c02_per_m), coefficients)


def change(path: Path, **values: Any) -> None:
    """Change values of a JSON file: those of the file, or those of each element of a list."""
    content = json.loads(path.read_text())
    for entry in content if isinstance(content, list) else [content]:
        entry.update(values)
    path.write_text(json.dumps(content))


@pytest.fixture
def handheld_run(run: Path) -> Path:
    """A run that found large errors of its camera."""
    change(run / "keyframes.json", camera_correction=LARGE.pack())
    change(run / "summary.json", calibration=METRICS)
    return run


def report(capsys: pytest.CaptureFixture[str], run: Path) -> list[str]:
    code, out, err = ldo(capsys, "doctor", "calibration", run)
    assert (code, err) == (0, "")
    return out.splitlines()


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("depth_m", [1.0, 3.0])
def test_depth_errors_are_those_of_the_simulated_camera(seed: int, depth_m: float) -> None:
    correction = simulated_correction(CAMERA, seed)
    true_m = np.full((CAMERA.height, CAMERA.width), depth_m)
    measured_m = DepthBias.of_seed(seed).biased(true_m, CAMERA)
    top_left, top_right = measured_m[0, 0], measured_m[0, -1]
    expected_mm = 1e3 * (np.array([top_left, top_right]) - depth_m)
    found_mm = (
        depth_errors_mm(correction, CAMERA, top_left)[0],
        depth_errors_mm(correction, CAMERA, top_right)[1],
    )
    np.testing.assert_allclose(found_mm, expected_mm, rtol=1e-9)
    assert measured_m[-1, -1] == pytest.approx(top_left)


def test_brightness_of_the_corners_is_that_of_the_simulated_camera() -> None:
    found = corner_brightness(simulated_correction(CAMERA, 0))
    np.testing.assert_allclose(found, vignetting(CAMERA)[0, 0], atol=0.01)


def test_exact_camera_has_no_correction_and_no_large_error(capsys, run: Path) -> None:
    lines = report(capsys, run)
    for name in ("depth bias", "vignetting", "readout of color", "readout of depth"):
        assert any(f" {name}: not corrected" in x or f" {name}: not comp" in x for x in lines), name
    assert not any("large errors" in line for line in lines)


def test_values_are_printed_with_their_evidence(capsys, handheld_run: Path) -> None:
    text = "\n".join(report(capsys, handheld_run))
    near, far = (depth_errors_mm(LARGE, CAMERA, depth_m) for depth_m in (1.0, 3.0))
    assert f"1 m is wrong by {near[0]:+.0f} mm at the top left" in text
    assert f"and by {near[1]:+.0f} mm at the top right" in text
    assert f"3 m is wrong by {far[0]:+.0f} mm and {far[1]:+.0f} mm there" in text
    assert "by a factor of 0.31" in text
    assert f"red {np.exp(-0.5):.2f}" in text
    assert "readout of color: compensated, 25.7 ms (1 sigma 0.4 ms)" in text
    assert "delay of depth after color: compensated, -15.0 ms (1 sigma 0.5 ms)" in text


def test_sigma_of_the_depth_bias_is_that_of_the_corners(capsys, handheld_run: Path) -> None:
    sigmas = np.array([0.0003, 0.0005, 0.0008])
    entries = {f"depth_bias_covariance_{i + 1}{i + 1}": s**2 for i, s in enumerate(sigmas)}
    change(handheld_run / "summary.json", calibration={**METRICS, **entries})
    camera = json.loads((handheld_run / "keyframes.json").read_text())[-1]["camera"]
    ratio = (camera["height"] - 1) / camera["width"]  # y of the top row; x is about 1.
    sigma_mm = 1e3 * 9 * np.sqrt(np.sum((sigmas * [1, ratio, ratio**2]) ** 2))
    (line,) = [x for x in report(capsys, handheld_run) if "depth bias: corrected" in x]
    found = line.split("1 sigma at 3 m: ")[1].split(" and ")[0]
    assert abs(float(found) - sigma_mm) < 0.6


def test_small_errors_of_depth_are_printed_with_sigma(capsys, run: Path) -> None:
    change(run / "summary.json", calibration={**METRICS, **EXTRINSICS.metrics()})
    lines = report(capsys, run)
    (pose,) = [x for x in lines if "pose of the depth camera" in x]
    assert pose.startswith("ok")
    assert "rotation +0.1, +0.1, +0.0 degrees (1 sigma 0.1, 0.1, 0.1)" in pose
    assert "shift at 2 m +1.5, -2.0 mrad (1 sigma 3.2, 3.2)" in pose


@pytest.mark.parametrize(
    ("changed", "name"),
    [
        ({"depth_color_rotation_z_deg": 0.5}, "pose of the depth camera"),
        ({"depth_color_translation_y_mm": -16.0}, "pose of the depth camera"),
        ({"depth_color_shift_u_mrad": 10.0}, "pose of the depth camera"),
    ],
)
def test_large_errors_of_depth_are_warned_of_if_they_are_significant(
    capsys, run: Path, changed: dict[str, float], name: str
) -> None:
    metrics = {**METRICS, **EXTRINSICS.metrics(), **changed}
    change(run / "summary.json", calibration=metrics)
    (line,) = [x for x in report(capsys, run) if name in x]
    assert line.startswith("warn")
    uncertain = {key: 9.9 for key in metrics if key.startswith("depth_") and "_sigma_" in key}
    change(run / "summary.json", calibration={**metrics, **uncertain})
    (line,) = [x for x in report(capsys, run) if name in x]
    assert line.startswith("ok")


@pytest.mark.parametrize(("count", "level"), [(4.0, "ok"), (40.0, "warn")])
def test_frames_with_contradictions_are_warned_of_if_they_are_many(
    capsys, run: Path, count: float, level: str
) -> None:
    counts = {"frames_aligned": 50.0, "frames_contradictory": count}
    change(run / "summary.json", calibration={**METRICS, **counts})
    (line,) = [x for x in report(capsys, run) if "color and depth: " in x]
    assert line.startswith(level)
    assert f"in {2 * count:.0f} % of 50 frames" in line


def test_contradictions_name_the_errors_that_were_found(capsys, handheld_run: Path) -> None:
    counts = {"frames_aligned": 50.0, "frames_contradictory": 40.0}
    change(handheld_run / "summary.json", calibration={**METRICS, **counts})
    (line,) = [x for x in report(capsys, handheld_run) if "color and depth: " in x]
    assert line.startswith("ok")
    assert "depth bias, vignetting, timing of the shutter" in line


def test_large_errors_are_warned_of_with_the_setting_that_helps(capsys, handheld_run: Path) -> None:
    warnings = [line for line in report(capsys, handheld_run) if line.startswith("warn")]
    assert len(warnings) == 2
    for name in ("depth bias", "vignetting", "timing of the shutter"):
        assert name in warnings[0]
    assert f"--set tracker.calibration_run={handheld_run}" in warnings[0]
    assert "synchronizes" in warnings[1]


def test_uncertain_time_says_how_to_turn(capsys, handheld_run: Path) -> None:
    metrics = {**METRICS, "depth_readout_sigma_ms": 7.5}
    change(handheld_run / "summary.json", calibration=metrics)
    (line,) = [x for x in report(capsys, handheld_run) if " readout of depth" in x]
    assert line.startswith("warn")
    assert "25.2 ms (1 sigma 7.5 ms). This estimate is uncertain" in line


def test_times_that_are_not_significant_are_printed_with_sigma(capsys, run: Path) -> None:
    times = {f"{name}_ms": 0.0 for name in ("readout", "depth_readout", "depth_delay")}
    change(run / "summary.json", calibration={**METRICS, **times})
    (line,) = [x for x in report(capsys, run) if "readout of color" in x]
    assert "not compensated, estimated as 25.8 ms (1 sigma 0.4 ms)" in line


def test_probable_depth_bias_that_is_not_confirmed_is_warned_of(capsys, run: Path) -> None:
    change(run / "summary.json", calibration={**METRICS, "depth_bias_residual_ratio": 0.88})
    (line,) = [x for x in report(capsys, run) if "depth bias" in x]
    assert line.startswith("warn")
    assert "not confirmed" in line


def test_unfinished_calibration_says_how_to_move(capsys, run: Path) -> None:
    change(run / "summary.json", calibration={**METRICS, "calibration_finished": 0.0})
    first = report(capsys, run)[0]
    assert first.startswith("warn")
    assert "turn it by 30 degrees" in first


def test_run_of_an_earlier_version_has_values_without_uncertainty(
    capsys, handheld_run: Path
) -> None:
    summary = json.loads((handheld_run / "summary.json").read_text())
    del summary["calibration"]
    (handheld_run / "summary.json").write_text(json.dumps(summary))
    text = "\n".join(report(capsys, handheld_run))
    assert "states no uncertainties" in text
    assert "readout of color: compensated, 25.7 ms (uncertainty unknown)" in text


def test_localized_run_names_the_run_of_its_map(capsys, run: Path) -> None:
    config = (run / "config.yaml").read_text()
    assert "localization_map: ''" in config
    (run / "config.yaml").write_text(config.replace("localization_map: ''", "localization_map: m"))
    code, _, err = ldo(capsys, "doctor", "calibration", run)
    assert code == 3
    assert "Give m, the run that made the map" in err


@pytest.mark.parametrize("content", ["[]", "{", '{"calibration": {"readout_ms": []}}'])
def test_damaged_summary_is_a_data_error(capsys, run: Path, content: str) -> None:
    (run / "summary.json").write_text(content)
    code, _, err = ldo(capsys, "doctor", "calibration", run)
    assert code == 3
    assert "summary.json" in err


@pytest.mark.parametrize("words", [("calibration",), ("service", "runs/desk")])
def test_folder_belongs_to_the_check_of_the_calibration(capsys, words: tuple[str, ...]) -> None:
    code, _, err = ldo(capsys, "doctor", *words)
    assert code == 2
    assert "ldo doctor calibration runs/desk" in err
