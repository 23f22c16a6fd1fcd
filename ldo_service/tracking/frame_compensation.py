"""Pyramid of the current frame, with the motion of the camera during the frame compensated.

Conventions: `ldo_service.geometry`.
"""

from dataclasses import replace

from ldo_service.calibration.shutter import FrameMotion
from ldo_service.geometry import RgbdFrame, se3

from .keyframes import ReferenceKeyframe
from .odometry_config import OdometryConfig
from .pose_candidates import InitialGuessAligner, PoseHypothesis
from .pyramid import Pyramid, pyramid_of
from .shutter import ShutterState, needs_realignment
from .shutter_timing import band_equations
from .state import OdometryState
from .tracking_quality import TrackingStatus


class FrameCompensator:
    """Compensation of the motion during each frame, without state from one frame to the next."""

    def __init__(self, config: OdometryConfig, guesses: InitialGuessAligner) -> None:
        self.config = config
        self.guesses = guesses
        self._view: tuple[RgbdFrame, Pyramid] | None = None  # The last frame and its pyramid.
        # Motion that the last pyramid compensates; None if the motion of the frame is unknown.
        self.motion: FrameMotion | None = None

    def expect(self, frame: RgbdFrame, state: OdometryState) -> Pyramid:
        """Compensate a frame that is not tracked yet with the motion of the frames before it."""
        expected = state.shutter.expected_motion(state.motion, frame.stamp_ns, self.config.shutter)
        return self._compensated(frame, expected)

    def view(self, frame: RgbdFrame) -> Pyramid:
        """Return the pyramid of a frame; that of the last frame is cached."""
        if self._view is None or self._view[0] is not frame:
            return self._compensated(frame, None)
        return self._view[1]

    def measure(
        self,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        candidate: PoseHypothesis,
        status: TrackingStatus,
        state: OdometryState,
    ) -> tuple[PoseHypothesis, ShutterState]:
        """Compensate a frame with the motion that its pose shows.

        The frame is aligned again if this motion is not as expected.

        Args:
            frame: The frame of the last call of `expect`.
            keyframe: The reference of the frame.
            candidate: The pose of the frame.
            status: Tracking status of the frame. Only OK frames are evidence for the timing.
            state: State before the frame.

        Returns:
            The pose of the compensated frame, and the next state of the compensation.
        """
        config = self.config.shutter
        if not config.is_on or state.status is TrackingStatus.LOST:
            self.motion = None
            return candidate, state.shutter.interrupted()
        T_odom_camera = keyframe.T_odom_keyframe @ candidate.alignment.T_reference_camera
        shutter, is_ok = state.shutter, status is TrackingStatus.OK
        if not is_ok:
            shutter = replace(shutter, pending=None)
        shutter, motion = shutter.moved(state.motion, T_odom_camera, frame.stamp_ns, config)
        if motion is None:
            return candidate, shutter
        focal_ratio, depth_m = frame.camera.fx / frame.camera.width, candidate.median_depth_m
        if needs_realignment(self.motion, motion, depth_m, focal_ratio, config):
            view = self._compensated(frame, motion)
            candidate = self.guesses.align_again(keyframe, view, candidate)
        elif self.motion is None:
            self.motion = motion  # Too slow to matter.
        if is_ok:
            shutter = self._with_pending(shutter, frame, keyframe, candidate)
        return candidate, shutter

    def forget(self) -> None:
        """Drop the last frame."""
        self._view = self.motion = None

    def _compensated(self, frame: RgbdFrame, motion: FrameMotion | None) -> Pyramid:
        self._view = frame, pyramid_of(frame, self.config.pyramid, motion)
        self.motion = motion
        return self._view[1]

    def _with_pending(
        self,
        shutter: ShutterState,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        candidate: PoseHypothesis,
    ) -> ShutterState:
        """Add the equations of a frame for the times of the shutter, while they are estimated."""
        velocity_there, motion = shutter.reference_velocity, self.motion
        is_due = shutter.evidence.count < self.config.shutter.max_frames
        if not is_due or velocity_there is None or keyframe.motion is None or motion is None:
            return shutter
        equations = band_equations(
            keyframe.reference,
            self.view(frame),
            se3.inverse(candidate.alignment.T_reference_camera),
            candidate.alignment.appearance,
            self.config.align.residuals,
            keyframe.motion,
            motion,
            velocity_there,
        )
        return replace(shutter, pending=equations)
