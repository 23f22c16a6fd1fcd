"""Report on the camera of a finished run, as `ldo doctor calibration` prints it."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from ldo_service.calibration.correction import (
    BIAS_COVARIANCE,
    BIAS_TERMS,
    CameraCorrection,
    bias_basis,
    read_correction,
    unbiased_depth,
)
from ldo_service.calibration.outlines import NAMES, SHIFT_DEPTH_M, SIGMA_NAMES
from ldo_service.calibration.self_calibration import SelfCalibrationConfig
from ldo_service.config import load_config
from ldo_service.errors import DataError
from ldo_service.geometry import Camera
from ldo_service.runs.finished import read_viewpoints, require_file
from ldo_service.tracking.shutter import ShutterConfig

from .findings import Finding

DEPTHS_M = 1.0, 3.0  # Depths at which the depth bias is stated.
# Minimum depth error at 3 m that the report warns of: more than the noise of a Kinect there.
LARGE_DEPTH_ERROR_MM = 30.0
# Maximum brightness of a corner, relative to the center, that the report warns of.
LARGE_VIGNETTING = 0.8
# Minimum readout or delay that the report warns of. During this time, a turn of 60 degrees/s moves
# the image by 6 of 640 pixels.
LARGE_TIME_MS = 10.0
# Minimum standard deviation of a time in use that the report warns of: 3 pixels in the same turn.
UNCERTAIN_TIME_MS = 5.0
# Maximum held-out residual, relative to that without a correction, at which an unconfirmed depth
# bias is probable. The sequence kitchen has 0.93, and a correction of its depth does harm.
PROBABLE_RATIO = 0.90
# Errors that the report warns of must exceed this many standard deviations, and a limit. The limits
# are 2 to 3 of 640 pixels for a camera with a usual lens, and the accuracy of a Kinect.
SIGMAS = 3.0
LARGE_ROTATION_DEG, LARGE_TRANSLATION_MM, LARGE_SHIFT_MRAD = 0.3, 10.0, 5.0
# Minimum fraction of frames with contradictions of color and depth that the report warns of.
# It is 10 to 23 % with exact cameras.
MANY_CONTRADICTIONS = 0.5
CHANNELS = "red", "green", "blue"
TIMES = {  # Names in the metrics, and in the report.
    "readout": "readout of color",
    "depth_readout": "readout of depth",
    "depth_delay": "delay of depth after color",
}
MOVE = "move the camera by half a meter and turn it by 30 degrees at the start of a run"


def camera_findings(folder: Path) -> Iterator[Finding]:
    """Report what a finished run has found about its camera.

    Args:
        folder: Folder of the run.

    Raises:
        DataError: A file of the run is missing or invalid.
        ConfigError: The run has settings of an earlier version.
    """
    tracker = load_config(require_file(folder, "config.yaml")).tracker
    if tracker.localization_map:
        raise DataError(
            f"{folder} is a run with --localize, which uses the calibration of its map. Give "
            f"{tracker.localization_map}, the run that made the map."
        )
    viewpoints = list(read_viewpoints(folder).values())
    if not viewpoints:
        raise DataError(f"{folder} has no keyframes. Give the folder of a run with a map.")
    correction, camera = read_correction(folder), viewpoints[-1].camera
    metrics = _metrics(folder)
    yield _progress(metrics, is_on=tracker.self_calibration, known=tracker.calibration_run)
    yield _depth_bias(correction, camera, metrics)
    yield _vignetting(correction, metrics)
    for name, text in TIMES.items():
        yield _time(name, text, correction, metrics)
    yield _contradiction(correction, metrics)
    yield from _large(folder, correction, camera)
    yield Finding(
        "note",
        "scale of depth: unknown, because it cannot be estimated from images. Measure a known "
        "length in the map, and correct depth_scale of the camera",
    )
    yield _extrinsics(metrics)


def depth_errors_mm(correction: CameraCorrection, camera: Camera, depth_m: float) -> np.ndarray:
    """Return the error of a measured depth in two corners of the image, mm.

    Args:
        correction: Correction of the camera.
        camera: Rectified camera of the keyframes.
        depth_m: Measured depth, meters.

    Returns:
        Measured minus corrected depth in mm, [2]: in the top left and the top right corner. Each
        bottom corner has the error of the diagonally opposite top corner. The error in the center
        is 0.
    """
    u, v = np.array([0.0, camera.width - 1.0]), np.zeros(2)
    bias = bias_basis(u, v, camera) @ np.array(correction.depth_bias)
    return 1e3 * (depth_m - unbiased_depth(np.full(2, depth_m), bias))


def corner_brightness(correction: CameraCorrection) -> np.ndarray:
    """Return the brightness of the corners relative to the center, [3] for red, green and blue."""
    return np.exp(np.array(correction.vignetting).sum(axis=1))


def _progress(metrics: Mapping[str, float], *, is_on: bool, known: str) -> Finding:
    start = f"started with the calibration of {known}" if known else "started without a calibration"
    if not is_on:
        return Finding("note", f"self-calibration: off (tracker.self_calibration=false), {start}")
    if not metrics:
        return Finding(
            "note",
            f"self-calibration: {start}. summary.json states no uncertainties, because the run "
            "reused a front end, or an earlier version wrote it. Run `ldo run` on the sequence "
            "again to get them",
        )
    if metrics["calibration_finished"]:
        return Finding("ok", f"self-calibration: finished, {start}")
    views = f"{metrics['calibration_views']:.0f} of {SelfCalibrationConfig().views[-1]} views"
    return Finding(
        "warn",
        f"self-calibration: not finished ({views}), {start}. The corrections of vignetting and "
        f"depth bias may be missing or still change. To finish, {MOVE}",
    )


def _depth_bias(
    correction: CameraCorrection, camera: Camera, metrics: Mapping[str, float]
) -> Finding:
    limit, ratio = SelfCalibrationConfig().max_depth_ratio, _ratio(metrics, "depth_bias")
    evidence = _held_out(ratio, limit)
    if correction.has_depth_bias:
        near, far = (depth_errors_mm(correction, camera, depth_m) for depth_m in DEPTHS_M)
        return Finding(
            "ok",
            f"depth bias: corrected. A measured depth of {DEPTHS_M[0]:g} m is wrong by "
            f"{near[0]:+.0f} mm at the top left and bottom right, and by {near[1]:+.0f} mm at the "
            f"top right and bottom left. A measured depth of {DEPTHS_M[1]:g} m is wrong by "
            f"{far[0]:+.0f} mm and {far[1]:+.0f} mm there{_bias_sigma(metrics, camera)}. In the "
            f"center, the error is 0{evidence}",
        )
    if ratio is not None and limit < ratio <= PROBABLE_RATIO:
        return Finding(
            "warn",
            f"depth bias: probable, but not confirmed and not corrected{evidence}. Tracking may "
            f"confuse it with rotation. To confirm it, {MOVE}, or set tracker.calibration_run to a "
            "run of this camera that corrected it",
        )
    if ratio is None:
        return Finding("note", f"depth bias: not corrected{evidence}")
    return Finding("ok", f"depth bias: not corrected, none found{evidence}")


def _bias_sigma(metrics: Mapping[str, float], camera: Camera) -> str:
    """Return the standard deviations of the depth error in two corners at the larger depth."""
    covariance = np.zeros((BIAS_TERMS, BIAS_TERMS))
    for name, (i, j) in BIAS_COVARIANCE.items():
        covariance[i, j] = covariance[j, i] = metrics.get(name, 0.0)
    if not covariance.any():
        return ""
    u, v = np.array([0.0, camera.width - 1.0]), np.zeros(2)
    basis = bias_basis(u, v, camera)
    sigmas = np.sqrt(np.einsum("ni,ij,nj->n", basis, covariance, basis))
    left, right = (1e3 * DEPTHS_M[-1] ** 2 * sigmas).tolist()
    return f" (1 sigma at {DEPTHS_M[-1]:g} m: {left:.0f} and {right:.0f} mm)"


def _extrinsics(metrics: Mapping[str, float]) -> Finding:
    """Report the error of the pose between depth and color camera."""
    pose = "pose of the depth camera relative to the color camera"
    if NAMES[0] not in metrics:
        return Finding(
            "note",
            f"{pose}: not estimated. The estimate needs near objects whose outlines are visible in "
            "color and depth",
        )
    values = [metrics[name] for name in NAMES]
    sigmas = [metrics[name] for name in SIGMA_NAMES]
    parts = []
    for name, part, unit in (
        ("rotation", slice(0, 3), "degrees"),
        ("translation", slice(3, 6), "mm"),
        (f"shift at {SHIFT_DEPTH_M:g} m", slice(6, 8), "mrad"),
    ):
        found = ", ".join(f"{value:+.1f}" for value in values[part])
        sigma = ", ".join(f"{value:.1f}" for value in sigmas[part])
        parts.append(f"{name} {found} {unit} (1 sigma {sigma})")
    text = f"{pose}: error of {'; '.join(parts)}"
    limits = [LARGE_ROTATION_DEG] * 3 + [LARGE_TRANSLATION_MM] * 3 + [LARGE_SHIFT_MRAD] * 2
    each = zip(values, sigmas, limits, strict=True)
    if any(abs(value) > max(SIGMAS * sigma, limit) for value, sigma, limit in each):
        return Finding(
            "warn",
            f"{text}. Edges of near objects get the color of the surface behind them. Register "
            "depth to color with the calibration of this camera, or calibrate the camera again",
        )
    return Finding("ok", text)


def _vignetting(correction: CameraCorrection, metrics: Mapping[str, float]) -> Finding:
    limit, ratio = SelfCalibrationConfig().max_color_ratio, _ratio(metrics, "vignetting")
    evidence = _held_out(ratio, limit)
    if not correction.has_vignetting and ratio is None:
        return Finding("note", f"vignetting: not corrected{evidence}")
    if not correction.has_vignetting:
        return Finding("ok", f"vignetting: not corrected, no strong vignetting found{evidence}")
    corners = zip(CHANNELS, corner_brightness(correction), strict=True)
    values = ", ".join(f"{name} {value:.2f}" for name, value in corners)
    return Finding(
        "ok",
        f"vignetting: corrected. Brightness of the corners relative to the center: {values}"
        f"{evidence}",
    )


def _ratio(metrics: Mapping[str, float], name: str) -> float | None:
    """Return the held-out residual of the last estimate; None if the run made no estimate."""
    ratio = metrics.get(f"{name}_residual_ratio", 1.0)
    return None if ratio == 1.0 else ratio


def _held_out(ratio: float | None, limit: float) -> str:
    if ratio is None:
        return " (no estimate in this run)"
    return (
        f" (the correction changes the residual of held-out frames by a factor of {ratio:.2f}; "
        f"{limit:g} or less confirms it)"
    )


def _time(
    name: str, text: str, correction: CameraCorrection, metrics: Mapping[str, float]
) -> Finding:
    is_used, config = bool(correction.timing), ShutterConfig()
    used_ms = metrics.get(f"{name}_ms", correction.timing.metrics()[f"{name}_ms"])
    sigma_ms = metrics.get(f"{name}_sigma_ms")
    if is_used:
        sigma = "uncertainty unknown" if sigma_ms is None else f"1 sigma {sigma_ms:.1f} ms"
        used = f"{text}: compensated, {used_ms:.1f} ms ({sigma})"
        if sigma_ms is None or sigma_ms < UNCERTAIN_TIME_MS:
            return Finding("ok", used)
        return Finding(
            "warn",
            f"{used}. This estimate is uncertain. To improve it, turn the camera faster: left, "
            "right, up and down",
        )
    if sigma_ms is None:
        return Finding(
            "note",
            f"{text}: not compensated, because there is no estimate. An estimate needs frames that "
            f"are at most {config.max_interval_s:g} s apart while the camera turns",
        )
    return Finding(
        "ok",
        f"{text}: not compensated, estimated as {metrics[f'{name}_estimate_ms']:.1f} ms (1 sigma "
        f"{sigma_ms:.1f} ms). The readouts of color and depth and the delay of depth are "
        f"compensated once one of them exceeds {1e3 * config.min_s:g} ms and {config.sigmas:g} "
        "sigma",
    )


def _contradiction(correction: CameraCorrection, metrics: Mapping[str, float]) -> Finding:
    """Report in how many frames color and depth contradicted each other."""
    aligned = metrics.get("frames_aligned", 0.0)
    if not aligned:
        return Finding("note", "color and depth: not compared in this run")
    ratio = metrics["frames_contradictory"] / aligned
    text = (
        f"color and depth: they favor different poses in {100 * ratio:.0f} % of {aligned:.0f} "
        "frames, whose uncertainty is increased"
    )
    if ratio < MANY_CONTRADICTIONS:
        return Finding("ok", text)
    errors = {
        "depth bias": correction.has_depth_bias,
        "vignetting": correction.has_vignetting,
        "timing of the shutter": bool(correction.timing),
    }
    found = [name for name, is_found in errors.items() if is_found]
    if found:
        return Finding(
            "ok",
            f"{text}. Errors of the camera that can cause this were found and are corrected: "
            f"{', '.join(found)}",
        )
    return Finding(
        "warn",
        f"{text}. The camera has an error that was not found, such as {', '.join(errors)}, or a "
        "wrong pose of the depth camera relative to the color camera. To find it, set "
        f"tracker.self_calibration=true, and {MOVE}",
    )


def _large(folder: Path, correction: CameraCorrection, camera: Camera) -> Iterator[Finding]:
    """Warn of large errors of the camera.

    Each run has these errors until its self-calibration has estimated them.
    """
    large: list[str] = []
    if np.abs(depth_errors_mm(correction, camera, DEPTHS_M[-1])).max() >= LARGE_DEPTH_ERROR_MM:
        large.append("depth bias (wrong poses and surfaces)")
    if corner_brightness(correction).min() <= LARGE_VIGNETTING:
        large.append("vignetting (dark colors in the map)")
    times_ms = correction.timing.metrics()
    if max(map(abs, times_ms.values())) >= LARGE_TIME_MS:
        large.append("timing of the shutter (distorted frames while the camera moves)")
    if large:
        yield Finding(
            "warn",
            f"large errors of this camera: {', '.join(large)}. Each run has these errors until it "
            "has estimated them. Start the next run of this camera with the result of this run: "
            f"--set tracker.calibration_run={folder}",
        )
    if abs(times_ms["depth_delay_ms"]) >= LARGE_TIME_MS:
        yield Finding(
            "warn",
            "depth and color are recorded at different times. If the camera has a setting that "
            "synchronizes them, switch it on",
        )


def _metrics(folder: Path) -> Mapping[str, float]:
    """Return the evidence of the calibration in summary.json; empty if there is none.

    Raises:
        DataError: The file is missing or invalid.
    """
    path = require_file(folder, "summary.json")
    try:
        metrics = json.loads(path.read_text()).get("calibration", {})
        return {str(name): float(value) for name, value in metrics.items()}
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror}. Give the folder of a finished `ldo run`."
        ) from error
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(
            f"{path} does not have the format that `ldo run` writes ({error!r}). Give the folder "
            "of a finished `ldo run`."
        ) from error
