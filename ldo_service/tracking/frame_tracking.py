"""Frame-to-keyframe tracking: the pose of a frame against its reference keyframe.

The tracker first aligns a frame from the pose that a constant-velocity model predicts. It then
tries all other initial guesses if the first result is not OK, or if the image has moved far since
the last frame. The quality of the best result determines the tracking status. If the status is
LOST, the tracker relocalizes the camera. The module `odometry` decides which frames become
keyframes. Conventions: `ldo_service.geometry`.
"""

import logging
from dataclasses import replace

import numpy as np

from ldo_service.calibration.knowledge import CameraKnowledge
from ldo_service.calibration.shutter import FrameMotion
from ldo_service.geometry import RgbdFrame, se3

from .aligner import choose_aligner
from .alignment import Alignment
from .frame_compensation import FrameCompensator
from .keyframe_database import KeyframeDatabase, make_thumbnail
from .keyframes import ReferenceKeyframe
from .motion import ConstantVelocity
from .motion_segmentation import grow_mask, segment_motion
from .odometry_config import OdometryConfig
from .odometry_prior import DeadReckoningStart, PriorPose
from .pose_candidates import InitialGuessAligner, PoseHypothesis
from .pyramid import Pyramid
from .relocalization import Relocalizer
from .shutter import ShutterState
from .state import KeyframeOrigin, OdometryState
from .submaps import SubmapMatch, SubmapMeasurement, Submaps
from .tracking_quality import ResidualHistory, TrackingStatus, classify_tracking
from .tracking_result import KeyframeKind, TrackedFrame

log = logging.getLogger(__name__)


class FrameTracker:
    """Pose tracking of one camera, frame by frame.

    `state` contains everything that the result of the next frame depends on. Equal sequences of
    frames give bitwise equal results.
    """

    def __init__(self, config: OdometryConfig) -> None:
        self.config = config
        self.state = OdometryState(shutter=ShutterState(config.shutter.initial))
        self.aligner = choose_aligner(config.device)
        self._relocalizer = Relocalizer(
            *(config.pyramid, config.align, config.features, config.tracking_quality),
            *(config.relocalization, self.aligner),
        )
        self._guesses = InitialGuessAligner(
            *(config.align, config.features, config.shape),
            *(config.candidates, config.large_motion, self.aligner),
        )
        self._compensator = FrameCompensator(config, self._guesses)
        self._prior: PriorPose | None = None  # Prior of the last frame.

    @property
    def can_reuse_keyframes(self) -> bool:
        """True if at least `keyframe_reuse.after` keyframes were made and this setting is not 0."""
        return 0 < self.config.keyframe_reuse.after <= self.state.next_id

    def track(self, frame: RgbdFrame, prior: PriorPose | None = None) -> TrackedFrame:
        """Track a frame, and return its pose with the tracking status.

        Args:
            frame: The frame; it may have neither texture nor depth.
            prior: Camera pose from another odometry, such as wheels; None if unknown. It yields an
                additional initial guess and the start pose of a new submap after a loss. A frame is
                OK only if its images confirm the resulting pose.
        """
        view, keyframe = self._compensator.expect(frame, self.state), self.state.keyframe
        self._prior = prior
        if keyframe is None:
            return self._first_result(view)
        # Alignment and tracking status.
        candidate = self._track_against(keyframe, view, frame.stamp_ns)
        status = self._classify(candidate)
        if status is TrackingStatus.WEAK and not self._relocalizer.resembles_last_trusted(
            view, self.state.trusted_thumbnail
        ):
            status = TrackingStatus.LOST
        # Relocalization.
        if status is TrackingStatus.LOST:
            found = self._relocalize(view, self._records_when_lost(), is_lost=True)
            if found is None:
                return self._lost_result(frame, keyframe, candidate.alignment)
            (keyframe, candidate), status = found, TrackingStatus.OK
            # Noise differs between scenes, and motion evidence is valid for one keyframe only.
            origin = KeyframeOrigin.KNOWN if self.can_reuse_keyframes else KeyframeOrigin.NEW
            self.state = replace(
                self.state, history=ResidualHistory(), motion_evidence=None, origin=origin
            )
        # Motion, dynamic mask, need of a keyframe, and search of other submaps.
        measured = self._compensator.measure(frame, keyframe, candidate, status, self.state)
        candidate, shutter = measured
        if status is TrackingStatus.WEAK and self._classify(candidate) is TrackingStatus.OK:
            status = TrackingStatus.OK  # The compensation explains the residuals.
        self.state = replace(self.state, shutter=shutter)
        tracked = self._accepted_result(frame, keyframe, candidate, status)
        tracked = self._search_other_submaps(tracked, keyframe, self.view(frame))
        if tracked.needed_keyframe is not None:
            self._compensator.finish(frame)
        return tracked

    def start_submap(self, frame: RgbdFrame) -> TrackedFrame:
        """Return the LOST frame just tracked as the first frame of a new submap.

        The new submap starts at the last pose before the loss, so that the pose in odometry does
        not jump. If an odometry prior measured the motion during the loss, that motion is added.
        """
        submap = len(self.state.submaps.roots)
        log.info("tracker: starting submap %d at frame %d.", submap, frame.index)
        T_odom_camera = self._dead_reckoned_pose()
        if T_odom_camera is None:
            T_odom_camera = self.state.motion.T_odom_camera
        return TrackedFrame(
            TrackingStatus.OK,
            "first",
            T_odom_camera,
            submap=submap,
            needed_keyframe=KeyframeKind.FIRST,
        )

    def restart_at(self, frame: RgbdFrame, T_odom_camera: np.ndarray) -> None:
        """Reset tracking to T_odom_camera [4, 4], the pose of the last frame; start a submap."""
        self.state = replace(
            self.state,
            motion=ConstantVelocity(T_odom_camera, stamp_ns=frame.stamp_ns),
            status=TrackingStatus.OK,
            trusted_thumbnail=make_thumbnail(self.view(frame)),
            history=ResidualHistory(),
            submaps=self.state.submaps.started(),
            dynamic_mask=None,
            motion_evidence=None,
            dead_reckoning_start=self._prior and DeadReckoningStart(T_odom_camera, self._prior),
            shutter=self.state.shutter.interrupted(),
        )

    def relocalize_in(
        self, frame: RgbdFrame, database: KeyframeDatabase
    ) -> tuple[ReferenceKeyframe, Alignment] | None:
        """Relocalize the frame just tracked in a keyframe database.

        Returns:
            The matching keyframe and the alignment of the frame to it; None if no keyframe is
            verified.
        """
        found = self._relocalize(self.view(frame), database, is_lost=False)
        return None if found is None else (found[0], found[1].alignment)

    def view(self, frame: RgbdFrame) -> Pyramid:
        """Return the image pyramid of a frame; the pyramid of the last frame is cached."""
        return self._compensator.view(frame)

    @property
    def motion(self) -> FrameMotion | None:
        """Estimated motion of the camera during the last frame; None if it is unknown."""
        return self._compensator.motion

    def use_knowledge(self, camera: CameraKnowledge) -> None:
        """Apply new estimates of shutter timing and depth-bias uncertainty to the next frames."""
        align = self.config.align.with_bias(camera.relative_bias_sigma)
        self._compensator.guesses = self._guesses = replace(self._guesses, align=align)
        self.state = self.state.informed(camera, self.config.pyramid, self.config.shutter)

    def restore(self, state: OdometryState) -> None:
        """Continue tracking from a saved state."""
        self.state = state
        self._compensator.forget()

    # --- initial guesses and the tracking status --------------------------------------------------
    def _first_result(self, view: Pyramid) -> TrackedFrame:
        if not self._is_usable(view):
            return TrackedFrame(TrackingStatus.LOST, "none", np.eye(4))
        return TrackedFrame(
            TrackingStatus.OK, "first", np.eye(4), needed_keyframe=KeyframeKind.FIRST
        )

    def _is_usable(self, view: Pyramid) -> bool:
        """Return whether a frame has enough measured depth to be tracked or become a keyframe."""
        measured = float(np.mean(view.levels[0].depth_m > 0))
        return measured >= self.config.tracking_quality.min_paired

    def _track_against(
        self, keyframe: ReferenceKeyframe, view: Pyramid, stamp_ns: int
    ) -> PoseHypothesis:
        """Align a frame from the predicted pose, and also from all other guesses if needed.

        The other guesses are needed if the tracking status of the first result is not OK, or if the
        image has moved far since the last frame.
        """
        motion = self.state.motion
        T_keyframe_odom = se3.inverse(keyframe.T_odom_keyframe)
        T_keyframe_previous = T_keyframe_odom @ motion.T_odom_camera
        predicted = self._guesses.align_from_guess(
            keyframe, view, T_keyframe_odom @ motion.predicted(stamp_ns)
        )
        is_sure = self._classify(predicted) is TrackingStatus.OK
        if is_sure and not self._guesses.is_large_step(predicted, T_keyframe_previous, view):
            return predicted
        T_odom_camera = self._dead_reckoned_pose()
        T_keyframe_reckoned = None if T_odom_camera is None else T_keyframe_odom @ T_odom_camera
        return self._guesses.align_from_all_guesses(
            predicted, keyframe, view, T_keyframe_previous, T_keyframe_reckoned
        )

    def _dead_reckoned_pose(self) -> np.ndarray | None:
        """Return T_odom_camera [4, 4] of the last frame by dead reckoning with the odometry prior.

        Dead reckoning adds the motion of the prior since the last OK frame to the pose of that
        frame. The result is None if the prior does not cover this time span.
        """
        start, now = self.state.dead_reckoning_start, self._prior
        if start is None or now is None:
            return None
        return start.dead_reckon(now, self.config.prior)

    def _classify(self, candidate: PoseHypothesis) -> TrackingStatus:
        state = self.state
        return classify_tracking(
            candidate, state.history, state.status, self.config.tracking_quality
        )

    # --- relocalization ---------------------------------------------------------------------------
    def _records_when_lost(self) -> KeyframeDatabase:
        """Add the last mapping keyframe to the database, and return the database.

        The mapping keyframe is newer than the reference keyframe and thus closer to the last camera
        pose, which helps to relocalize the camera.
        """
        before = self.state
        if before.mapping_keyframe is not None:
            database = before.database.with_record(
                before.mapping_keyframe, self.config.keyframe_database
            )
            self.state = replace(before, database=database, mapping_keyframe=None)
        return self.state.database

    def _relocalize(
        self, view: Pyramid, database: KeyframeDatabase, *, is_lost: bool
    ) -> tuple[ReferenceKeyframe, PoseHypothesis] | None:
        if not self._is_usable(view):
            return None
        state = self.state
        self.state = replace(state, relocalization_count=state.relocalization_count + 1)
        return self._relocalizer.find(
            view, database, state.relocalization_count, state.history, is_lost=is_lost
        )

    def _search_other_submaps(
        self, tracked: TrackedFrame, keyframe: ReferenceKeyframe, view: Pyramid
    ) -> TrackedFrame:
        """Search for the frame in the keyframes of other submaps, once every few frames.

        If a match is confirmed, the returned frame is marked to become a keyframe. That keyframe
        then merges the submaps.
        """
        before, config = self.state.submaps, self.config.submaps
        if tracked.status is not TrackingStatus.OK or not before.is_search_due(config):
            return tracked
        database = self.state.records_of_other_submaps(keyframe.submap)
        found = self._relocalize(view, database, is_lost=False)
        match = measurement = None
        if found is not None:
            there, alignment = found[0], found[1].alignment
            match = SubmapMatch.at(there, alignment, tracked.submap, tracked.T_odom_camera)
            measurement = SubmapMeasurement.of(there, alignment)
        self.state = replace(self.state, submaps=before.with_search_result(match, config))
        if match is None or not before.is_confirmed_by(match, config):
            return tracked
        needed = KeyframeKind.REFERENCE
        return replace(tracked, needed_keyframe=needed, submap_measurement=measurement)

    # --- results ----------------------------------------------------------------------------------
    def _lost_result(
        self, frame: RgbdFrame, keyframe: ReferenceKeyframe, alignment: Alignment
    ) -> TrackedFrame:
        motion = self.state.motion.without_velocity()
        self._remember(frame, keyframe, motion, self.state.history, TrackingStatus.LOST)
        self.state = replace(self.state, dynamic_mask=None, motion_evidence=None)
        T_keyframe_camera = se3.inverse(keyframe.T_odom_keyframe) @ motion.T_odom_camera
        lost = TrackedFrame.of(
            replace(alignment, T_reference_camera=T_keyframe_camera, information=np.zeros((6, 6))),
            motion.T_odom_camera,
            keyframe,
            TrackingStatus.LOST,
            "none",
        )
        is_long_lost = self.state.submaps.should_start(self.config.submaps)
        should_start = is_long_lost and self._is_usable(self.view(frame))
        return replace(lost, should_start_submap=should_start)

    def _accepted_result(
        self,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        candidate: PoseHypothesis,
        status: TrackingStatus,
    ) -> TrackedFrame:
        alignment, history, config = candidate.alignment, self.state.history, self.config
        T_odom_camera = se3.orthonormalize(keyframe.T_odom_keyframe @ alignment.T_reference_camera)
        motion = self.state.motion.moved_to(T_odom_camera, frame.stamp_ns)
        is_steady = status is TrackingStatus.OK and self.state.status is TrackingStatus.OK
        if status is TrackingStatus.OK:
            history = history.extended(alignment, config.tracking_quality)
            anchor = self._prior and DeadReckoningStart(T_odom_camera, self._prior)
            trusted = make_thumbnail(self.view(frame))
            self.state = replace(self.state, trusted_thumbnail=trusted, dead_reckoning_start=anchor)
        self._remember(
            frame, keyframe, motion if is_steady else motion.without_velocity(), history, status
        )
        # Static surfaces would look dynamic too if the pose is uncertain.
        dynamic_mask = None
        if status is TrackingStatus.OK:
            dynamic_mask = self._segment_motion(keyframe, self.view(frame), alignment)
        if self.state.origin is KeyframeOrigin.KNOWN:
            # A known keyframe may be old. An object that was placed there later looks dynamic,
            # although it stands still.
            dynamic_mask = None
            self.state = replace(self.state, dynamic_mask=None)
        needed = None
        if status is TrackingStatus.OK:
            depth_m = candidate.median_depth_m
            needed = self.state.needed_keyframe(T_odom_camera, alignment, depth_m, config.keyframes)
        return TrackedFrame.of(
            alignment,
            T_odom_camera,
            keyframe,
            status,
            candidate.pose_source,
            needed_keyframe=needed,
            hypothesis_spread_rad=candidate.hypothesis_spread_rad,
            dynamic_mask=dynamic_mask,
        )

    def _segment_motion(
        self, keyframe: ReferenceKeyframe, view: Pyramid, alignment: Alignment
    ) -> np.ndarray | None:
        """Return the dynamic mask of a frame, [H, W] bool; None if motion segmentation is off.

        If much of the keyframe's surface has moved away, the ignore mask of the keyframe is
        updated.
        """
        config = self.config.moving
        if not config.is_on:
            return None
        seen = segment_motion(
            view,
            keyframe.view,
            keyframe.moved_mask,
            alignment.T_reference_camera,
            alignment.depth_noise_scale,
            self.state.motion_evidence,
            config,
            self.config.align.residuals.noise,
        )
        self.state = replace(
            self.state, dynamic_mask=seen.dynamic_mask, motion_evidence=seen.evidence
        )
        if seen.has_large_change(keyframe.moved_mask, config):
            renewed = keyframe.with_moved(seen.moved_mask, config)
            self.state = replace(self.state, keyframe=renewed)
        return grow_mask(seen.dynamic_mask, view, config)

    def _remember(
        self,
        frame: RgbdFrame,
        keyframe: ReferenceKeyframe,
        motion: ConstantVelocity,
        history: ResidualHistory,
        status: TrackingStatus,
    ) -> None:
        before = self.state
        if status is not before.status:
            log.info(
                "tracker: tracking status changed from %s to %s at keyframe %d.",
                *(before.status, status, keyframe.id),
            )
        self.state = replace(
            before,
            keyframe=keyframe,
            motion=motion,
            history=history,
            status=status,
            frames_since_keyframe=before.frames_since_keyframe + 1,
            submaps=self._submaps_after(frame, status),
        )

    def _submaps_after(self, frame: RgbdFrame, status: TrackingStatus) -> Submaps:
        if status is not TrackingStatus.LOST:
            return self.state.submaps.after_tracked()
        view = self.view(frame)
        thumbnail = make_thumbnail(view) if self._is_usable(view) else None
        return self.state.submaps.after_lost(thumbnail, self.config.submaps)
