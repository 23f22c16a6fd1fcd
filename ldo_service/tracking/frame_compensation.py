"""Image pyramid of the current frame, compensated for the camera motion during the frame.

Conventions: `ldo_service.geometry`.
"""

from dataclasses import replace

import numpy as np

from ldo_service.calibration.shutter import FrameMotion, ShutterTiming, displacement_rad
from ldo_service.geometry import RgbdFrame, se3

from .keyframes import ReferenceKeyframe
from .motion_segmentation import shows_motion
from .odometry_config import OdometryConfig
from .pose_candidates import InitialGuessAligner, PoseHypothesis
from .pyramid import Pyramid, compensated_pyramid, luminance
from .shutter import ShutterState, displacement_ratio
from .shutter_timing import BandEquations, band_equations
from .state import OdometryState
from .tracking_quality import TrackingStatus

# Timing of a fictitious shutter, to express a velocity as the image motion within 10 ms.
TEN_MS = ShutterTiming(depth_delay_s=0.01)
# A second alignment of a frame counts as worse if the ratio of its overlap to that of the first
# alignment is below WORSE_OVERLAP, or the ratio of the noise is above WORSE_NOISE. Compensation of
# the true motion increases the overlap and lowers the noise.
WORSE_OVERLAP, WORSE_NOISE = 0.8, 1.5


class FrameCompensator:
    """Builder of image pyramids that are compensated for the camera motion during the frame.

    The object keeps only a cache of the last frame; `forget` clears this cache.
    """

    def __init__(self, config: OdometryConfig, guesses: InitialGuessAligner) -> None:
        self.config = config
        self.guesses = guesses
        self._view: tuple[RgbdFrame, Pyramid] | None = None  # The last frame and its pyramid.
        self._gray: tuple[RgbdFrame, np.ndarray] | None = None  # The last frame, its luminance.
        # Motion that the pyramid compensates; None if the motion of the frame is unknown.
        self._compensated: FrameMotion | None = None
        # Motion during the last frame that its pose was computed for; None if unknown.
        self.motion: FrameMotion | None = None

    def expect(self, frame: RgbdFrame, state: OdometryState) -> Pyramid:
        """Return the pyramid of a new frame, compensated for the expected camera motion.

        The motion of the camera is predicted from the last frames. The compensation covers the
        rolling shutter and the delay of depth.
        """
        expected = state.shutter.expected_motion(state.motion, frame.stamp_ns, self.config.shutter)
        return self._compensate(frame, expected)

    def view(self, frame: RgbdFrame) -> Pyramid:
        """Return the image pyramid of a frame; the pyramid of the last frame is cached."""
        if self._view is None or self._view[0] is not frame:
            return self._compensate(frame, None)
        return self._view[1]

    def finish(self, frame: RgbdFrame) -> None:
        """Compensate the last frame again if `measure` has corrected the motion of this frame.

        Args:
            frame: The frame of the last call of `expect`.
        """
        if self.motion is not self._compensated:
            self._compensate(frame, self.motion)

    def measure(
        self,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        candidate: PoseHypothesis,
        status: TrackingStatus,
        state: OdometryState,
    ) -> tuple[PoseHypothesis, ShutterState]:
        """Measure the motion of the camera during a frame, and return the pose for this motion.

        The frame was compensated for the expected motion. What follows depends on the relative
        difference between the measured and the expected motion:

        - up to `ShutterConfig.realign_ratio`: the pose stays as it is.
        - up to `ShutterConfig.max_linear_ratio`, if the frame is OK and is not made a keyframe: the
          pose is corrected to first order.
        - otherwise: the frame is compensated and aligned again.

        Args:
            frame: The frame of the last call of `expect`.
            keyframe: Reference keyframe of the frame.
            candidate: Pose of the frame from tracking.
            status: Tracking status of the frame. Only OK frames contribute to the estimated timing
                of rolling shutter and depth.
            state: State of the odometry before the frame.

        Returns:
            The pose, and the next state of the compensation.
        """
        config, shutter = self.config.shutter, state.shutter
        is_jump = state.status is TrackingStatus.LOST or candidate.pose_source == "relocalized"
        motion = None
        if config.is_on and not is_jump:
            motion = self._measured_motion(frame, keyframe, candidate, state)
        if motion is None:
            self._interrupt(frame)
            return candidate, shutter.interrupted()
        is_ok = status is TrackingStatus.OK
        if not is_ok:
            shutter = replace(shutter, pending=None)
        equations, expected = None, self._compensated
        ratio = displacement_ratio(expected, motion, candidate.median_depth_m, frame.camera)
        if ratio > config.realign_ratio:
            is_small = ratio <= config.max_linear_ratio and is_ok
            if expected is None or not is_small or self._is_needed(keyframe, candidate, state):
                candidate = self._aligned_again(frame, keyframe, candidate, motion)
            else:
                equations = self._equations(frame, keyframe, candidate, shutter, expected)
                candidate = _corrected(candidate, equations, motion)
            motion = self._measured_motion(frame, keyframe, candidate, state)
            if motion is None:
                self._interrupt(frame)
                return candidate, shutter.interrupted()
        shutter = shutter.moved(motion, config)
        if equations is not None:
            self.motion = motion
        elif self.motion is None:
            self.motion = self._compensated = motion  # Too slow to matter.
        if is_ok and not shows_motion(state.dynamic_mask):  # Moving points are false evidence.
            shutter = self._with_pending(shutter, frame, keyframe, candidate, equations)
        return candidate, shutter

    def forget(self) -> None:
        """Clear the cache of the last frame."""
        self._view = self._gray = self.motion = self._compensated = None

    def _compensate(self, frame: RgbdFrame, motion: FrameMotion | None) -> Pyramid:
        if self._gray is None or self._gray[0] is not frame:
            self._gray = frame, luminance(frame)
        view = compensated_pyramid(self._gray[1], frame, self.config.pyramid, motion)
        self._view = frame, view
        self.motion = self._compensated = motion
        return view

    def _interrupt(self, frame: RgbdFrame) -> None:
        """Process a frame whose motion is unknown, without compensation."""
        if self.motion is not None:
            self._compensate(frame, None)

    def _is_needed(
        self, keyframe: ReferenceKeyframe, candidate: PoseHypothesis, state: OdometryState
    ) -> bool:
        """Return whether an OK frame with this pose becomes a keyframe."""
        alignment, depth_m = candidate.alignment, candidate.median_depth_m
        T_odom_camera = keyframe.T_odom_keyframe @ alignment.T_reference_camera
        config = self.config.keyframes
        return state.needed_keyframe(T_odom_camera, alignment, depth_m, config) is not None

    def _measured_motion(
        self,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        candidate: PoseHypothesis,
        state: OdometryState,
    ) -> FrameMotion | None:
        T_odom_camera = keyframe.T_odom_keyframe @ candidate.alignment.T_reference_camera
        return state.shutter.measured_motion(
            state.motion, T_odom_camera, frame.stamp_ns, self.config.shutter
        )

    def _aligned_again(
        self,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        candidate: PoseHypothesis,
        motion: FrameMotion,
    ) -> PoseHypothesis:
        """Compensate a frame with a motion and align it again, unless this makes it worse."""
        before = self._view, self._compensated
        again = self.guesses.align_again(keyframe, self._compensate(frame, motion), candidate)
        if not _is_worse(again, candidate):
            return again
        self._view, self._compensated = before
        self.motion = self._compensated
        return candidate

    def _equations(
        self,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        candidate: PoseHypothesis,
        shutter: ShutterState,
        compensated: FrameMotion,
    ) -> BandEquations:
        """Return the normal equations of a frame by bands of rows.

        If the motion of the reference is unknown, the reference counts as at rest.
        """
        unknown = np.zeros(6)
        velocity_there = shutter.reference_velocity
        return band_equations(
            keyframe.reference,
            self.view(frame),
            se3.inverse(candidate.alignment.T_reference_camera),
            candidate.alignment.appearance,
            self.config.align.residuals,
            keyframe.motion or FrameMotion(unknown, compensated.timing),
            compensated,
            unknown if velocity_there is None else velocity_there,
        )

    def _with_pending(
        self,
        shutter: ShutterState,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        candidate: PoseHypothesis,
        equations: BandEquations | None,
    ) -> ShutterState:
        """Add the equations of a frame to the evidence, while the shutter's times are estimated."""
        velocity_there, motion = shutter.reference_velocity, self._compensated
        if velocity_there is None or keyframe.motion is None or motion is None:
            return shutter
        config = self.config.shutter
        speed_rad = displacement_rad(motion.velocity, TEN_MS, candidate.median_depth_m)
        is_due = shutter.evidence.count < config.max_frames and speed_rad > config.min_motion_rad
        if not is_due or keyframe.view.camera != frame.camera:
            return shutter
        if equations is None:
            equations = self._equations(frame, keyframe, candidate, shutter, motion)
        else:  # The velocity of a new reference has been measured since.
            equations = replace(equations, reference_velocity=velocity_there)
        return replace(shutter, pending=equations if len(equations.rows) else None)


def _corrected(
    candidate: PoseHypothesis, equations: BandEquations, motion: FrameMotion
) -> PoseHypothesis:
    """Return the pose that alignment would find if `motion` were compensated instead."""
    alignment = candidate.alignment
    change = se3.exp(equations.pose_change(motion.velocity))
    T_reference_camera = se3.orthonormalize(alignment.T_reference_camera @ change)
    return replace(candidate, alignment=replace(alignment, T_reference_camera=T_reference_camera))


def _is_worse(again: PoseHypothesis, before: PoseHypothesis) -> bool:
    """Return whether a frame that was aligned again has clearly less overlap or more noise."""
    a, b = again.alignment, before.alignment
    return (
        a.overlap < WORSE_OVERLAP * b.overlap
        or a.intensity_sigma > WORSE_NOISE * b.intensity_sigma
        or a.depth_noise_scale > WORSE_NOISE * b.depth_noise_scale
    )
