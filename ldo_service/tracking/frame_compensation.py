"""Pyramid of the current frame, with the motion of the camera during the frame compensated.

Conventions: `ldo_service.geometry`.
"""

from dataclasses import replace

from ldo_service.calibration.shutter import FrameMotion, ShutterTiming, displacement_rad
from ldo_service.geometry import RgbdFrame, se3

from .keyframes import ReferenceKeyframe
from .motion_segmentation import shows_motion
from .odometry_config import OdometryConfig
from .pose_candidates import InitialGuessAligner, PoseHypothesis
from .pyramid import Pyramid, pyramid_of
from .shutter import ShutterState, needs_realignment
from .shutter_timing import band_equations
from .state import OdometryState
from .tracking_quality import TrackingStatus

# Timing by which the velocity of a frame is judged.
TEN_MS = ShutterTiming(depth_delay_s=0.01)
# A frame that is aligned again is worse below this ratio of the overlap before, or above this ratio
# of the noise. A compensation with a right motion increases the overlap and lowers the noise.
WORSE_OVERLAP, WORSE_NOISE = 0.8, 1.5


class FrameCompensator:
    """Pyramid of the current frame; nothing but a cache is kept from one frame to the next."""

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
        config, shutter = self.config.shutter, state.shutter
        is_jump = state.status is TrackingStatus.LOST or candidate.pose_source == "relocalized"
        if not config.is_on or is_jump:
            return candidate, self._interrupted(frame, shutter)
        is_ok = status is TrackingStatus.OK
        if not is_ok:
            shutter = replace(shutter, pending=None)
        moved, motion = self._moved(shutter, frame, keyframe, candidate, state)
        if motion is None:
            return candidate, self._interrupted(frame, moved)
        focal_ratio, depth_m = frame.camera.fx / frame.camera.width, candidate.median_depth_m
        if needs_realignment(self.motion, motion, depth_m, focal_ratio, config):
            before = self._view, self.motion
            view = self._compensated(frame, motion)
            again = self.guesses.align_again(keyframe, view, candidate)
            if _is_worse(again, candidate):
                self._view, self.motion = before
            else:
                candidate = again
                moved = self._moved(shutter, frame, keyframe, candidate, state)[0]
        elif self.motion is None:
            self.motion = motion  # Too slow to matter.
        if is_ok and not shows_motion(state.dynamic_mask):  # Moving points are false evidence.
            moved = self._with_pending(moved, frame, keyframe, candidate)
        return candidate, moved

    def _moved(
        self,
        shutter: ShutterState,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        candidate: PoseHypothesis,
        state: OdometryState,
    ) -> tuple[ShutterState, FrameMotion | None]:
        T_odom_camera = keyframe.T_odom_keyframe @ candidate.alignment.T_reference_camera
        return shutter.moved(state.motion, T_odom_camera, frame.stamp_ns, self.config.shutter)

    def _interrupted(self, frame: RgbdFrame, shutter: ShutterState) -> ShutterState:
        """Compensate nothing in a frame whose motion is unknown."""
        if self.motion is not None:
            self._compensated(frame, None)
        return shutter.interrupted()

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
        if velocity_there is None or keyframe.motion is None or motion is None:
            return shutter
        config = self.config.shutter
        speed_rad = displacement_rad(motion.velocity, TEN_MS, candidate.median_depth_m)
        is_due = shutter.evidence.count < config.max_frames and speed_rad > config.min_motion_rad
        if not is_due or keyframe.view.camera != frame.camera:
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
        return replace(shutter, pending=equations if len(equations.rows) else None)


def _is_worse(again: PoseHypothesis, before: PoseHypothesis) -> bool:
    """Return whether a frame that was aligned again has clearly less overlap or more noise."""
    a, b = again.alignment, before.alignment
    return (
        a.overlap < WORSE_OVERLAP * b.overlap
        or a.intensity_sigma > WORSE_NOISE * b.intensity_sigma
        or a.depth_noise_scale > WORSE_NOISE * b.depth_noise_scale
    )
