"""RGB-D odometry: one call per frame computes its pose and makes keyframes and submaps.

    odometry = Odometry()
    for frame in frames:
        result = odometry.process(frame, prior, may_map=has_credit)
        if result.keyframe is not None:
            ...  # Map the frame.

`Odometry.process` takes these steps for each frame, in this order:

1. Align the frame to the reference keyframe, or relocalize a lost camera (`FrameTracker`).
2. Start a submap if the camera has been lost for long.
3. If a keyframe is needed, search for a known keyframe that shows the same surface as the frame,
   and make it the reference.
4. If none is found, make a new keyframe and measure its pose relative to earlier keyframes. Merge
   two submaps if a match between them is confirmed.
5. Compute T_map_odom from the last correction of the pose graph (`MapFrame`).

With `may_map=False`, while the mapper is busy, step 4 makes no keyframe. If the camera then leaves
the view of its reference, a frame becomes the reference without being a keyframe (`Relay`).
Conventions: `ldo_service.geometry`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ldo_service.calibration.correction import CorrectionChange
from ldo_service.calibration.knowledge import CameraKnowledge
from ldo_service.detection.dynamic_classes import Box
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .alignment import BrightnessModel
from .background import with_foreground
from .frame_tracking import FrameTracker
from .keyframe_database import KeyframeRecord, make_keyframe_record
from .keyframe_reuse import KeyframeReuse, ReusedKeyframe, find_nearby_keyframes
from .keyframes import ReferenceKeyframe, keyframe_dynamic_class_mask, limit_ratio
from .map_frame import MapCorrection, MapFrame
from .odometry_config import OdometryConfig
from .odometry_prior import OdometryPriorBuffer, PriorPose
from .state import KeyframeOrigin, pack, unpack
from .tracking_quality import TrackingStatus
from .tracking_result import (
    KeyframeKind,
    NewKeyframe,
    TrackedFrame,
    TrackingResult,
    make_tracking_result,
)
from .window import RecentKeyframeCache, measure_against


class Odometry:
    """Odometry of one camera, with its pose in the map.

    Equal frames, priors and corrections give bitwise equal results.

    Attributes:
        aligner: Direct alignment on a GPU or on the CPU.
    """

    def __init__(
        self, config: OdometryConfig | None = None, T_base_camera: np.ndarray | None = None
    ) -> None:
        """Start without a keyframe.

        Args:
            config: Settings; None uses the defaults.
            T_base_camera: Pose of the camera in the robot's base frame, [4, 4]. It converts the
                poses of an odometry prior, which are poses of the base. None is the identity.
        """
        self.config = config or OdometryConfig()
        self._T_base_camera = np.eye(4) if T_base_camera is None else T_base_camera
        self._frames = FrameTracker(self.config)
        self.aligner = self._frames.aligner
        self._map = MapFrame()
        self._reuse = KeyframeReuse(
            *(self.config.pyramid, self.config.align, self.config.keyframes),
            *(self.config.tracking_quality, self.config.keyframe_reuse, self.aligner),
        )
        self._earlier = RecentKeyframeCache(self.config.pyramid)

    def process(
        self,
        frame: RgbdFrame,
        prior: OdometryPriorBuffer | None = None,
        *,
        may_map: bool = True,
        camera: CameraKnowledge | None = None,
    ) -> TrackingResult:
        """Track a frame, and make a keyframe of it if one is needed.

        Args:
            frame: The frame, which is not changed; it may have neither texture nor depth. A
                keyframe keeps its own copy of the depth.
            prior: The last poses of another odometry, such as wheels. They yield an additional
                initial guess, and dead reckoning while tracking is LOST. They do not replace the
                images: a frame is OK only if its images confirm the pose.
            may_map: True allows a new keyframe or submap. If it is False and a keyframe is needed,
                `TrackingResult.denied_keyframe` names the kind of keyframe.
            camera: Shutter timing and depth-bias uncertainty that the self-calibration has
                estimated so far; None if the self-calibration is off.

        Returns:
            The pose of the frame, and the keyframe that was made of it, if any.
        """
        # Track against the reference keyframe; relocalization may find another reference.
        reading = self._read(prior, frame)
        self._frames.use_knowledge(camera or CameraKnowledge())
        tracked = self._frames.track(frame, reading)
        if tracked.pose_source == "relocalized" and tracked.reference not in self._map:
            self._map.place_reference(tracked)
        # Start a submap after a long loss.
        needed = KeyframeKind.FIRST if tracked.should_start_submap else tracked.needed_keyframe
        if tracked.should_start_submap and may_map:
            tracked = self._frames.start_submap(frame)
        # Reuse a known keyframe as the reference instead of making a new keyframe. If the current
        # reference has no measured pose relative to a known keyframe, one more keyframe is made
        # first. Its pose is measured relative to the known keyframe. This measurement connects the
        # known keyframe to the last references in the pose graph.
        known, reused = self._find_reusable_keyframe(frame, tracked), None
        if known is not None and self._is_connected_to_map:
            tracked = self._switch_to_keyframe(known, tracked)
            needed, reused, known = None, known.record.id, None
        # Make a keyframe with its relative-pose measurements; it may merge two submaps.
        keyframe = None
        view, state = self._frames.view(frame), self._frames.state
        if needed is not None:
            tracked = with_foreground(tracked, view, state.database, self.config)
        if needed is not None and may_map:
            keyframe = self._make_keyframe(frame, tracked, needed, known)
        elif needed is KeyframeKind.REFERENCE and self._has_left_keyframe(tracked):
            self._frames.state = state.with_relay(view, tracked, self._frames.motion)
        # Return T_map_odom of the reference with the pose.
        reference = tracked.reference
        if reference is None and keyframe is not None:
            reference = keyframe.id
        denied = None if may_map else needed
        return make_tracking_result(
            tracked,
            self._map.T_map_odom(reference),
            self._map.version,
            self._map.root_of(tracked.submap),
            reference,
            has_prior=reading is not None,
            motion=self._frames.motion,
            shutter=self._frames.state.shutter,
            keyframe=keyframe,
            reused_keyframe=reused,
            denied_keyframe=denied,
            awaits_mapping=denied is not None and tracked.pose_source == "first",
        )

    def correct(self, correction: MapCorrection) -> bool:
        """Correct the map poses of keyframes; their poses in the odometry frame do not change.

        Returns:
            True if the correction is newer than the last one. Otherwise it changes nothing.
        """
        return self._map.correct(correction)

    def recorrect(self, change: CorrectionChange) -> None:
        """Replace the vignetting and depth-bias correction of all keyframe images; keep poses."""
        state = self._frames.state
        self._frames.restore(state.recorrected(change, self.config.pyramid))

    def mask_dynamic_objects(self, keyframe: int, boxes: Sequence[Box]) -> None:
        """Mask objects of dynamic classes in the reference keyframe and in its record.

        Args:
            keyframe: Id of the keyframe in which the boxes were detected. If it is no longer the
                reference keyframe, nothing changes.
            boxes: Detections, in pixels of the keyframe's image.
        """
        state = self._frames.state
        reference = state.keyframe
        if reference is None or reference.id != keyframe or reference.relay is not None:
            return
        mask = keyframe_dynamic_class_mask(reference.view, boxes, self.config.movable)
        if mask.any():
            self._frames.state = replace(
                state,
                keyframe=replace(reference, dynamic_class_mask=mask),
                database=state.database.without(mask, keyframe),
            )

    @property
    def reference(self) -> int | None:
        """Id of the reference keyframe of the next frame; None before the first keyframe."""
        keyframe = self._frames.state.keyframe
        return None if keyframe is None else keyframe.id

    def snapshot(self) -> dict[str, Any]:
        """Return the state that the next results depend on, without the last `MapCorrection`.

        Returns:
            Arrays and plain values. A keyframe or record that has not changed since the last
            snapshot is the same object, so the caller can detect changes by identity.
        """
        return {**pack(self._frames.state), "poses": self._map.snapshot()}

    def restore(self, state: Mapping[str, Any], correction: MapCorrection | None = None) -> None:
        """Continue from a snapshot; the next frames give the same results bit for bit.

        Args:
            state: The snapshot.
            correction: The last correction before the snapshot.
        """
        self._frames.restore(unpack(dict(state), self.config.pyramid))
        self._map.restore(state["poses"], correction)
        self._earlier = RecentKeyframeCache(self.config.pyramid)

    def _read(self, prior: OdometryPriorBuffer | None, frame: RgbdFrame) -> PriorPose | None:
        """Return the camera pose by the odometry prior at the time of a frame, or None."""
        if prior is None:
            return None
        return prior.at(frame.stamp_ns, self._T_base_camera, self.config.prior)

    # --- keyframe reuse ---------------------------------------------------------------------------
    @property
    def _is_connected_to_map(self) -> bool:
        """True if the reference is a reused keyframe or has a measured pose relative to one."""
        return self._frames.state.origin is not KeyframeOrigin.NEW

    def _has_left_keyframe(self, tracked: TrackedFrame) -> bool:
        """Return whether an OK frame is so far from its reference that it must become a relay.

        A relay is a reference for tracking that is no keyframe. `KeyframeConfig.relay_ratio` sets
        the limits.
        """
        keyframe = self._frames.state.keyframe
        if keyframe is None:
            return False
        T_reference_camera = se3.inverse(keyframe.T_odom_keyframe) @ tracked.T_odom_camera
        config, depth_m = self.config.keyframes, keyframe.reference.median_depth_m
        is_far = limit_ratio(T_reference_camera, depth_m, config) > config.relay_ratio
        return is_far or tracked.overlap < config.min_overlap / config.relay_ratio

    def _find_reusable_keyframe(
        self, frame: RgbdFrame, tracked: TrackedFrame
    ) -> ReusedKeyframe | None:
        """Find a known keyframe to use instead of the new keyframe that a frame needs.

        Returns:
            The known keyframe. None if the frame needs no keyframe or merges submaps, if reuse is
            off, or if no known keyframe is verified.
        """
        is_needed = tracked.needed_keyframe is not None and tracked.submap_measurement is None
        if not is_needed or not self._frames.can_reuse_keyframes:
            return None
        T_map_camera = self._map.T_map_camera(tracked)
        if T_map_camera is None:
            return None
        state = self._frames.state
        known = [
            record
            for record in state.database.all
            if record.id != tracked.reference
            and state.submaps.are_merged(record.submap, tracked.submap)
        ]
        near = find_nearby_keyframes(
            known, self._map.T_map_keyframe, T_map_camera, self.config.keyframes
        )
        return self._reuse.find(self._frames.view(frame), near, state.history)

    def _switch_to_keyframe(self, known: ReusedKeyframe, tracked: TrackedFrame) -> TrackedFrame:
        """Make a known keyframe the reference, and return the pose of the frame relative to it.

        The pose of the frame in odometry does not change. The keyframe gets a new pose in odometry
        and moves to the current submap.
        """
        alignment = known.candidate.alignment
        T_odom_keyframe = se3.orthonormalize(
            tracked.T_odom_camera @ se3.inverse(alignment.T_reference_camera)
        )
        here = {"T_odom_keyframe": T_odom_keyframe, "submap": tracked.submap}
        record, keyframe = replace(known.record, **here), replace(known.keyframe, **here)
        self._frames.state = self._frames.state.with_reused_keyframe(
            keyframe, record, tracked.T_odom_camera
        )
        switched = TrackedFrame.of(
            alignment,
            tracked.T_odom_camera,
            keyframe,
            TrackingStatus.OK,
            known.candidate.pose_source,
        )
        self._map.place_reference(switched)
        return switched

    # --- new keyframes ----------------------------------------------------------------------------
    def _make_keyframe(
        self,
        frame: RgbdFrame,
        tracked: TrackedFrame,
        kind: KeyframeKind,
        known: ReusedKeyframe | None,
    ) -> NewKeyframe:
        """Make a keyframe of a frame, measure its relative poses, and add it to the `MapFrame`.

        Args:
            frame: The frame just tracked.
            tracked: The tracking result of the frame.
            kind: The kind of keyframe that the frame needs. If `known` is given, a reference
                keyframe is made instead of a mapping keyframe.
            known: Known keyframe that the pose of the new one is measured relative to, which
                connects both in the pose graph. None if there is none.
        """
        window: list[RelativePose] = []
        if kind is KeyframeKind.MAPPING and known is None:
            keyframe = self._add_mapping_keyframe(frame, tracked)
        else:
            kind = KeyframeKind.REFERENCE if kind is KeyframeKind.MAPPING else kind
            keyframe = self._add_reference(frame, tracked, is_connected=known is not None)
            window = self._measure_window(tracked)
            if known is not None:
                others = (measured for measured in window if measured.a != known.record.id)
                window = [known.measurement_of(keyframe), *others]
        self._map.add_keyframe(keyframe, tracked, self.reference)
        merge = tracked.submap_measurement
        measurement = None if merge is None else merge.measurement_of(keyframe)
        return NewKeyframe(keyframe, kind, tracked.submap, tuple(window), measurement)

    def _add_reference(
        self, frame: RgbdFrame, tracked: TrackedFrame, *, is_connected: bool = False
    ) -> int:
        """Make the frame just tracked the reference keyframe, and return the id of the keyframe.

        Args:
            frame: The frame.
            tracked: The tracking result of the frame, not LOST.
            is_connected: True if the pose of the new keyframe is measured relative to a known one.
                The next frames may then reuse known keyframes.
        """
        frames = self._frames
        if tracked.pose_source == "first":
            frames.restart_at(frame, tracked.T_odom_camera)
        if tracked.submap_measurement is not None:
            other = tracked.submap_measurement.submap
            submaps = frames.state.submaps.with_merge(tracked.submap, other)
            frames.state = replace(frames.state, submaps=submaps)
        keyframe = self._keyframe_of(frame, tracked)
        record = self._record_of(keyframe)
        frames.state = frames.state.with_new(
            keyframe, record, self.config.keyframe_database, is_measured=is_connected
        )
        return keyframe.id

    def _add_mapping_keyframe(self, frame: RgbdFrame, tracked: TrackedFrame) -> int:
        """Make the frame a mapping keyframe, and return its id; the reference does not change.

        The record of the mapping keyframe is kept, because this keyframe is the closest one to the
        camera if tracking is lost next.
        """
        keyframe = self._keyframe_of(frame, tracked)
        self._frames.state = replace(
            self._frames.state,
            mapping_keyframe=self._record_of(keyframe),
            next_id=keyframe.id + 1,
            T_odom_last_mapped=tracked.T_odom_camera,
        )
        return keyframe.id

    def _measure_window(self, tracked: TrackedFrame) -> list[RelativePose]:
        """Measure the pose of the new reference keyframe relative to earlier ones of its submap.

        The previous reference keyframe is excluded, since tracking has measured that pose already.
        """
        keyframe = self._frames.state.keyframe
        if keyframe is None or tracked.reference is None:
            return []
        without = {keyframe.id, tracked.reference}
        records = self._frames.state.database.in_submap(keyframe.submap, without)
        earlier = self._earlier.newest_first(records, self.config.window.reach)
        usual = BrightnessModel(
            intensity_sigma=tracked.intensity_sigma, depth_noise_scale=tracked.depth_noise_scale
        )
        config = self.config
        return measure_against(earlier, keyframe, usual, config.align, config.window, self.aligner)

    def _keyframe_of(self, frame: RgbdFrame, tracked: TrackedFrame) -> ReferenceKeyframe:
        view = self._frames.view(frame)
        view = replace(view, depth_m=view.depth_m.copy())  # A camera may reuse its buffer.
        return ReferenceKeyframe(
            view,
            tracked.T_odom_camera,
            self._frames.state.next_id,
            tracked.submap,
            moved_mask=self._frames.state.dynamic_mask,
            ignore_mask=tracked.dynamic_mask,
            motion=self._frames.motion,
        )

    def _record_of(self, keyframe: ReferenceKeyframe) -> KeyframeRecord:
        history, config = self._frames.state.history, self.config
        return make_keyframe_record(keyframe, config.features, config.keyframe_database, history)
