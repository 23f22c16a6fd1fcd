"""Self-calibration of a camera from the first views of a run.

    calibration = SelfCalibration()
    for raw in frames:
        frame = calibration.correction.applied(raw)
        ...  # Track the frame, with `calibration.knowledge`.
        change = calibration.observe(raw, T_odom_camera, motion)

A rolling shutter distorts the views of a moving camera. Its timing is therefore estimated together
with the depth bias, but is not part of the correction. The tracker uses the timing to compensate
the motion within each frame, and refines the timing (`ShutterState`).

Each call of `observe` does a bounded part of the work, so that the tracker skips no frame. An
estimate is used only if it clearly reduces the residuals of held-out pairs of views. The last
estimate uses the largest number of views. After it, the calibration costs no more time.
"""

import logging
from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import RgbdFrame, se3

from .comparison import TIME_TERMS
from .correction import (
    BIAS_COVARIANCE,
    BIAS_TERMS,
    VIGNETTING_TERMS,
    CameraCorrection,
    CorrectionChange,
)
from .estimation import DEPTH_PRIOR, Estimate, estimate
from .knowledge import CameraKnowledge
from .outlines import Extrinsics
from .shutter import FrameMotion, ShutterTiming
from .views import CalibrationView, ViewMaker, ViewPair, median_depth_m, pair_of

log = logging.getLogger(__name__)

PAIR_DISTANCES = (1, 2, 3, 5, 8)  # A new view is paired with the views this many views before it.
WORK_PER_FRAME = 12.0  # Work of an estimate in one frame, in the unit of `estimate`: 10 ms.
VIEW_WORK = 6.0  # Work of making a view, in the same unit.


@dataclass(frozen=True, slots=True)
class SelfCalibrationConfig:
    """Settings of the self-calibration.

    `max_depth_ratio` and `max_color_ratio` were chosen on seven recordings and simulations. The
    depth ratio was at most 0.85 with a strong depth bias, and above 0.94 without a strong bias.
    The color ratio was at most 0.15 with strong vignetting, and above 0.45 without strong
    vignetting.
    """

    # Numbers of views at which an estimate starts. The estimate at the last number ends the
    # calibration. Empty: no calibration.
    views: tuple[int, ...] = (4, 6, 9, 15, 30)
    # Minimum image motion from one view to the next, fraction of the image width: 12 px of 640.
    view_motion: float = 12 / 640
    lost_frames: int = 3  # Frames from one view to the next while tracking is LOST.
    min_pairs: int = 3  # An estimate from fewer pairs of views is skipped.
    # A correction is used if it reduces the residual of held-out pairs to at most this fraction.
    max_depth_ratio: float = 0.86  # Limit for the depth bias.
    max_color_ratio: float = 0.3  # Limit for the vignetting.

    def __post_init__(self) -> None:
        if any(n < 2 for n in self.views) or list(self.views) != sorted(set(self.views)):
            raise ConfigError(
                named(self, "views") + ": view counts must ascend, and each must be at least 2."
            )
        if not self.view_motion > 0 or min(self.lost_frames, self.min_pairs) < 1:
            raise ConfigError(
                named(self, "view_motion", "lost_frames", "min_pairs")
                + ": view_motion must be positive; lost_frames and min_pairs must be at least 1."
            )
        if not (0 <= self.max_depth_ratio <= 1 and 0 <= self.max_color_ratio <= 1):
            raise ConfigError(
                named(self, "max_depth_ratio", "max_color_ratio") + ": both must be within 0..1."
            )


class SelfCalibration:
    """Self-calibration of one camera.

    Equal frames and poses give bitwise equal results, also after `restore`.
    """

    def __init__(self, config: SelfCalibrationConfig | None = None) -> None:
        """Start without a correction."""
        self.config = config or SelfCalibrationConfig()
        self.correction = CameraCorrection()
        self.ratios = (1.0, 1.0)  # Held-out residuals of the last estimate: depth, color.
        # Covariance of the last estimate of the depth bias, [3, 3] 1/m^2; 0 before the first one.
        self.depth_bias_covariance = np.zeros((BIAS_TERMS, BIAS_TERMS))
        self.extrinsics: Extrinsics | None = None  # Result of the estimate from most views.
        self.is_finished = not self.config.views
        self._maker = ViewMaker()
        self._views: dict[int, CalibrationView] = {}
        self._pairs: list[ViewPair] = []
        self._T_last_view: np.ndarray | None = None
        self._frames_since_view = 0
        # Initial coefficients of the next estimate: the result of the last one, even if rejected.
        self._depth_bias = np.zeros(BIAS_TERMS)
        self._times_s = np.zeros(TIME_TERMS)
        self._vignetting = np.zeros((3, VIGNETTING_TERMS))
        self._timing: np.ndarray | None = None  # See `CameraKnowledge.timing`.
        # View of the last frame with the velocity before that frame; the next frame gives the
        # velocity after it.
        self._new_view: int | None = None
        # Packed parts of the state; a part that has not changed stays the same object.
        self._packed: dict[str, dict[str, Any]] = {"maker": self._maker.pack()}
        self._has_estimate = False  # True after the first estimate, used or not.
        self._views_estimated = 0  # Number of views of the last estimate.
        # True if the correction is of an earlier run. Only an estimate from the largest number of
        # views may change it.
        self._is_renewed = False
        self._stage = 0  # Index into `config.views` of the next estimate.
        # Running estimate, the number of views that it uses, and the number of its steps done.
        self._running: Generator[float, None, Estimate] | None = None
        self._views_used = self._steps_done = 0

    @staticmethod
    def finished(correction: CameraCorrection) -> "SelfCalibration":
        """Return a finished calibration, whose correction is known and never changes."""
        calibration = SelfCalibration(SelfCalibrationConfig(views=()))
        calibration.correction = correction
        return calibration

    @staticmethod
    def continued(
        correction: CameraCorrection, config: SelfCalibrationConfig | None = None
    ) -> "SelfCalibration":
        """Return a calibration of a camera whose correction is known from an earlier run.

        The correction is used from the first frame on. Only the estimate from the largest number
        of views, max(`config.views`), may change it.
        """
        calibration = SelfCalibration(config)
        calibration.correction = replace(correction, timing=ShutterTiming())
        calibration._times_s = np.array(correction.timing.times_s)
        calibration._depth_bias = np.array(correction.depth_bias)
        calibration._vignetting = np.array(correction.vignetting)
        calibration._has_estimate = calibration._is_renewed = True
        calibration._views_estimated = max(calibration.config.views, default=0)
        calibration._forget()
        return calibration

    @property
    def is_undecided(self) -> bool:
        """True until the first estimate shows whether there is a depth bias."""
        return not (self.is_finished or self._has_estimate)

    @property
    def knowledge(self) -> CameraKnowledge:
        """Depth-bias uncertainty and estimated shutter timing, to track the next frame."""
        relative = 1.0
        if not self.is_undecided:
            covariance = self.depth_bias_covariance * DEPTH_PRIOR
            is_used = self.correction.has_depth_bias
            relative = min(float(np.trace(covariance) / BIAS_TERMS) ** 0.5, 1.0) if is_used else 0.0
        return CameraKnowledge(relative, self._timing)

    def observe(
        self,
        raw: RgbdFrame,
        T_odom_camera: np.ndarray | None,
        motion: FrameMotion | None = None,
    ) -> CorrectionChange | None:
        """Do one part of the work: continue an estimate, or make a calibration view of the frame.

        Args:
            raw: The frame without correction.
            T_odom_camera: Pose of the frame, [4, 4], which shows how far the camera has moved since
                the last view; None while tracking is LOST.
            motion: Mean motion from the last frame to this one; None if unknown.

        Returns:
            The change of the correction, which applies from the next frame on; None if the
            correction does not change.
        """
        if self.is_finished:
            return None
        self._frames_since_view += 1
        self._complete_view(motion)
        if self._running is None and len(self._views) >= self.config.views[self._stage]:
            self._start(len(self._views))
        work, is_first = 0.0, self._running is not None and not self._has_estimate
        if not (self.is_finished or is_first) and self._is_view_due(raw, T_odom_camera):
            self._take_view(raw, T_odom_camera, motion)
            work = VIEW_WORK
        return None if self._running is None else self._continue(work)

    def _complete_view(self, motion: FrameMotion | None) -> None:
        """Set the velocity of the last frame's view to the mean of those before and after it."""
        number, self._new_view = self._new_view, None
        if number is None or motion is None or number not in self._views:
            return
        view = self._views[number]
        before = view.velocity if view.velocity.any() else motion.velocity
        self._keep(replace(view, velocity=0.5 * (before + motion.velocity)))

    def _is_view_due(self, raw: RgbdFrame, T_odom_camera: np.ndarray | None) -> bool:
        if len(self._views) >= self.config.views[-1]:
            return False
        if T_odom_camera is None or self._T_last_view is None:
            return not self._views or self._frames_since_view >= self.config.lost_frames
        T_last_now = se3.inverse(self._T_last_view) @ T_odom_camera
        turned_rad = se3.rotation_angle(T_last_now)
        parallax_rad = se3.distance(T_last_now) / median_depth_m(raw)
        moved = (turned_rad + parallax_rad) * raw.camera.fx / raw.camera.width
        return moved >= self.config.view_motion

    def _take_view(
        self, raw: RgbdFrame, T_odom_camera: np.ndarray | None, motion: FrameMotion | None
    ) -> None:
        if self._views and next(iter(self._views.values())).camera != raw.camera:
            self._forget()  # Another camera or resolution.
        view = self._maker.make(raw, T_odom_camera, None if motion is None else motion.velocity)
        self._packed |= {"maker": self._maker.pack()}
        self._keep(view)
        self._new_view = view.number
        self._T_last_view, self._frames_since_view = T_odom_camera, 0
        for distance in PAIR_DISTANCES:
            earlier = self._views.get(view.number - distance)
            pair = None if earlier is None else pair_of(earlier, view)
            if pair is not None:
                self._pairs.append(pair)
        self._pairs.sort(key=lambda pair: (pair.first, pair.second))

    def _keep(self, view: CalibrationView) -> None:
        self._views[view.number] = view
        self._packed |= {f"view_{view.number}": view.pack()}

    def _forget(self) -> None:
        self._maker, self._views, self._pairs = ViewMaker(), {}, []
        self._packed = {"maker": self._maker.pack()}
        self._running = self._new_view = None
        enough = self._views_estimated + 1 if self._is_renewed else 0
        stages = [i for i, number in enumerate(self.config.views) if number >= enough]
        self._stage = min(stages, default=max(len(self.config.views) - 1, 0))

    # --- estimates --------------------------------------------------------------------------------
    def _start(self, count: int) -> None:
        """Start an estimate from the first `count` views; skip it if they form too few pairs.

        With fewer pairs than views, the views show little texture, and parts of the image depend on
        a few pairs.
        """
        self._views_used = count
        pairs = [pair for pair in self._pairs if pair.second < count]
        if len(pairs) < max(self.config.min_pairs, count - 1):
            self._end_stage()
            return
        views = {number: view for number, view in self._views.items() if number < count}
        start = self._depth_bias, self._times_s, self._vignetting
        is_last = count >= max(self.config.views, default=0)
        self._running = estimate(views, pairs, *start, finds_extrinsics=is_last)
        self._steps_done = 0

    def _continue(self, work: float = 0.0) -> CorrectionChange | None:
        """Continue the running estimate in one frame, after `work` units of other work."""
        assert self._running is not None
        try:
            while work < WORK_PER_FRAME:
                work += next(self._running)
                self._steps_done += 1
            return None
        except StopIteration as done:
            found: Estimate = done.value
        self._running, self._steps_done, self._has_estimate = None, 0, True
        self._views_estimated = self._views_used
        if not found.is_finite:
            self._end_stage()
            return None
        self._depth_bias, self._vignetting = found.depth_bias, found.vignetting
        self._times_s = found.times_s
        information = np.linalg.inv(found.times_covariance)
        self._timing = np.c_[information, information @ found.times_s]
        self.depth_bias_covariance = found.depth_bias_covariance
        self.ratios = found.depth_ratio, found.color_ratio
        poses = {(pair.first, pair.second): pair for pair in found.pairs}
        self._pairs = [poses.get((pair.first, pair.second), pair) for pair in self._pairs]
        self.extrinsics = found.extrinsics or self.extrinsics
        limits = self.config.max_depth_ratio, self.config.max_color_ratio
        new = found.confirmed(self.correction, limits, is_known=self._is_renewed)
        change = CorrectionChange(self.correction, new)
        self.correction = new
        self._end_stage()
        return None if change.old == new else change

    def _end_stage(self) -> None:
        """Select the next entry of `config.views` that is not reached yet, or finish."""
        limits = self.config.views
        is_last = len(self._views) >= limits[-1] and self._views_used >= limits[-1]
        while self._stage < len(limits) - 1 and limits[self._stage] <= self._views_used:
            self._stage += 1
        if not is_last:
            return
        self.is_finished = True
        self._forget()
        log.info(
            "tracker: self-calibration finished: depth bias %s (held-out residual with / without "
            "correction: %.2f), vignetting %s (%.2f).",
            "corrected" if self.correction.has_depth_bias else "not corrected",
            self.ratios[0],
            "corrected" if self.correction.has_vignetting else "not corrected",
            self.ratios[1],
        )

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, dict[str, Any]]:
        """Return the state as named parts; snapshots share the objects of unchanged parts."""
        now = {
            **self.correction.pack(),
            "ratios": list(self.ratios),
            "depth_bias_covariance": self.depth_bias_covariance,
            "extrinsics": self.extrinsics and [self.extrinsics.xi, self.extrinsics.covariance],
            "is_finished": self.is_finished,
            "last_depth_bias": self._depth_bias,
            "last_vignetting": self._vignetting,
            "T_last_view": self._T_last_view,
            "frames_since_view": self._frames_since_view,
            "stage": self._stage,
            "last_times_s": self._times_s,
            "timing_equations": self._timing,
            "new_view": self._new_view,
            "has_estimate": self._has_estimate,
            "views_estimated": self._views_estimated,
            "is_renewed": self._is_renewed,
            "is_running": self._running is not None,
            "views_used": self._views_used,
            "steps_done": self._steps_done,
            "views": list(self._views),
            "poses": [
                (pair.first, pair.second, pair.T_second_first.copy()) for pair in self._pairs
            ],
        }
        return {"now": now, **self._packed}

    def restore(self, state: Mapping[str, Mapping[str, Any]]) -> None:
        """Continue from a snapshot."""
        now = state["now"]
        self.correction = CameraCorrection.of(now)
        self.ratios = (float(now["ratios"][0]), float(now["ratios"][1]))
        unknown = np.zeros((BIAS_TERMS, BIAS_TERMS))
        self.depth_bias_covariance = now.get("depth_bias_covariance", unknown)
        self.extrinsics = Extrinsics(*now["extrinsics"]) if now.get("extrinsics") else None
        # If `config.views` is empty, the calibration is off: the restored correction stays.
        self.is_finished = bool(now["is_finished"]) or not self.config.views
        self._depth_bias, self._vignetting = now["last_depth_bias"], now["last_vignetting"]
        self._T_last_view = now["T_last_view"]
        self._frames_since_view = int(now["frames_since_view"])
        self._packed = {name: dict(part) for name, part in state.items() if name != "now"}
        self._maker = ViewMaker.unpack(state["maker"])
        self._views = {n: CalibrationView.unpack(state[f"view_{n}"]) for n in now["views"]}
        self._pairs = []
        for first, second, T_second_first in now["poses"]:
            pair = pair_of(self._views[first], self._views[second])
            if pair is not None:  # A version may reject a pair that an earlier one accepted.
                self._pairs.append(pair.at(T_second_first))
        # States of earlier versions lack some of the entries that are read by `get`.
        self._running, self._stage = None, int(now["stage"])
        self._times_s = now.get("last_times_s", np.zeros(TIME_TERMS))
        self._timing, self._new_view = now.get("timing_equations"), now.get("new_view")
        self._has_estimate = bool(now.get("has_estimate", True))
        self._views_estimated = int(now.get("views_estimated", 0))
        self._is_renewed = bool(now.get("is_renewed", False))
        self._views_used = int(now["views_used"])
        if now["is_running"]:
            self._start(self._views_used)
            # The estimate of an earlier version, which had other steps, starts again.
            for _ in range(int(now.get("steps_done", 0))):
                if self._running is not None:
                    next(self._running)
                    self._steps_done += 1

    def metrics(self) -> dict[str, float]:
        """Return the number of views, and for each correction 1 if it is in use, else 0."""
        return {
            # Views that the self-calibration has made so far; 0 when it is finished.
            "calibration_views": float(len(self._views)),
            "depth_bias_corrected": float(self.correction.has_depth_bias),
            "vignetting_corrected": float(self.correction.has_vignetting),
        }

    def evidence(self) -> dict[str, float]:
        """Return metrics that say how well the data support each estimate."""
        return {
            # 1 after the estimate from all views.
            "calibration_finished": float(self.is_finished),
            # Held-out residuals with the correction, divided by those without it.
            "depth_bias_residual_ratio": self.ratios[0],
            "vignetting_residual_ratio": self.ratios[1],
            **{name: float(self.depth_bias_covariance[at]) for name, at in BIAS_COVARIANCE.items()},
            **(self.extrinsics.metrics() if self.extrinsics else {}),
        }
