"""State of odometry between frames, and its packed form for checkpoints."""

from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np

from ldo_service.calibration.correction import CorrectionChange
from ldo_service.calibration.knowledge import CameraKnowledge
from ldo_service.calibration.shutter import FrameMotion, ShutterTiming
from ldo_service.geometry import se3

from .alignment import Alignment
from .keyframe_database import KeyframeDatabase, KeyframeDatabaseConfig, KeyframeRecord
from .keyframes import (
    KeyframeConfig,
    ReferenceKeyframe,
    needs_keyframe,
    needs_mapping_keyframe,
)
from .motion import ConstantVelocity
from .motion_segmentation import MotionEvidence
from .odometry_prior import DeadReckoningStart
from .pyramid import Pyramid, PyramidConfig
from .shutter import ShutterConfig, ShutterState
from .submaps import Submaps
from .tracking_quality import ResidualHistory, TrackingStatus
from .tracking_result import KeyframeKind, TrackedFrame


class KeyframeOrigin(StrEnum):
    """Relation of the reference keyframe to known keyframes; keyframe reuse depends on it."""

    NEW = "new"  # New, without a measured pose relative to a known keyframe.
    MEASURED = "tied"  # New, with a measured pose relative to a known keyframe.
    KNOWN = "known"  # Made earlier and reused; its surface is mapped.


@dataclass(frozen=True, slots=True)
class OdometryState:
    """Complete state of odometry that the result of the next frame depends on."""

    # Keyframe records for relocalization and keyframe reuse.
    database: KeyframeDatabase = field(default_factory=KeyframeDatabase)
    keyframe: ReferenceKeyframe | None = None  # The reference keyframe, usually the newest one.
    # Record of the last mapping keyframe, if it is newer than the reference keyframe.
    mapping_keyframe: KeyframeRecord | None = None
    motion: ConstantVelocity = field(default_factory=ConstantVelocity)
    history: ResidualHistory = field(default_factory=ResidualHistory)
    status: TrackingStatus = TrackingStatus.OK  # Status of the last frame.
    frames_since_keyframe: int = 0  # Frames since the reference keyframe was set.
    next_id: int = 0  # Id of the next keyframe.
    origin: KeyframeOrigin = KeyframeOrigin.NEW
    # Thumbnail of the last OK frame, [300] int8; empty before the first OK frame.
    trusted_thumbnail: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int8))
    relocalization_count: int = 0  # Number of searches in the keyframe database.
    submaps: Submaps = field(default_factory=Submaps)
    # Pose of the last mapped frame, [4, 4].
    T_odom_last_mapped: np.ndarray = field(default_factory=lambda: np.eye(4))
    # Dynamic pixels of the last frame, [H, W] bool at the finest pyramid level; None if unknown.
    dynamic_mask: np.ndarray | None = None
    motion_evidence: MotionEvidence | None = None
    # Poses of the last OK frame in odometry and in the odometry prior; None if the prior had no
    # pose at the time of that frame.
    dead_reckoning_start: DeadReckoningStart | None = None
    shutter: ShutterState = field(default_factory=ShutterState)

    @property
    def is_relayed(self) -> bool:
        """True if the reference, to which new frames are aligned, is not a keyframe."""
        return self.keyframe is not None and self.keyframe.relay is not None

    def records_of_other_submaps(self, submap: int) -> KeyframeDatabase:
        """Return the keyframe records of all submaps that are not merged with the given one."""
        are_merged = self.submaps.are_merged
        return KeyframeDatabase(
            tuple(p for p in self.database.all if not are_merged(p.submap, submap))
        )

    def needed_keyframe(
        self,
        T_odom_camera: np.ndarray,
        alignment: Alignment,
        median_depth_m: float,
        config: KeyframeConfig,
    ) -> KeyframeKind | None:
        """Return the kind of keyframe that an OK frame should become, or None.

        Args:
            T_odom_camera: Pose of the frame, [4, 4].
            alignment: Alignment of the frame to the reference keyframe.
            median_depth_m: Median depth of the reference keyframe.
            config: Settings.
        """
        is_known, frames = self.origin is KeyframeOrigin.KNOWN, self.frames_since_keyframe
        if is_known:  # The number of frames does not limit the use of a known keyframe.
            frames = min(frames, config.max_frames - 1)
        T_reference_camera, overlap = alignment.T_reference_camera, alignment.overlap
        left = needs_keyframe(T_reference_camera, overlap, median_depth_m, frames, config)
        if left or self.is_relayed:
            return KeyframeKind.REFERENCE
        T_mapped_camera = se3.inverse(self.T_odom_last_mapped) @ T_odom_camera
        if not is_known and needs_mapping_keyframe(T_mapped_camera, median_depth_m, config):
            return KeyframeKind.MAPPING
        return None

    def with_new(
        self,
        keyframe: ReferenceKeyframe,
        record: KeyframeRecord,
        config: KeyframeDatabaseConfig,
        *,
        is_measured: bool,
    ) -> "OdometryState":
        """Return the state with the frame just tracked as the new reference keyframe.

        Args:
            keyframe: The frame as a keyframe.
            record: The record of the keyframe, which is added to the database.
            config: Settings of the database.
            is_measured: True if the pose of the keyframe was measured relative to a known keyframe.
        """
        return replace(
            self._against(keyframe, keyframe.T_odom_keyframe),
            database=self.database.with_record(record, config),
            next_id=keyframe.id + 1,
            origin=KeyframeOrigin.MEASURED if is_measured else KeyframeOrigin.NEW,
        )

    def with_reused_keyframe(
        self, keyframe: ReferenceKeyframe, record: KeyframeRecord, T_odom_camera: np.ndarray
    ) -> "OdometryState":
        """Return the state with a known keyframe as the reference.

        Args:
            keyframe: The known keyframe.
            record: The record of the keyframe, which moves to the end of the database.
            T_odom_camera: Pose of the frame just tracked, [4, 4].
        """
        return replace(
            self._against(keyframe, T_odom_camera),
            database=self.database.with_reused(record),
            origin=KeyframeOrigin.KNOWN,
            dynamic_mask=None,
        )

    def with_relay(
        self, view: Pyramid, tracked: TrackedFrame, motion: FrameMotion | None
    ) -> "OdometryState":
        """Return the state with the frame just tracked as a reference that is no keyframe.

        Args:
            view: Pyramid of the frame.
            tracked: Pose and dynamic mask of the frame.
            motion: Motion of the camera during the frame; None if unknown.
        """
        assert self.keyframe is not None
        reference = ReferenceKeyframe(
            replace(view, depth_m=view.depth_m.copy()),  # A camera may reuse its buffer.
            tracked.T_odom_camera,
            self.keyframe.id,
            self.keyframe.submap,
            moved_mask=self.dynamic_mask,
            ignore_mask=tracked.dynamic_mask,
            relay=tracked.relay(),
            motion=motion,
        )
        evidence = self.motion_evidence and self.motion_evidence.of_new_keyframe()
        shutter = self.shutter.with_new_reference()
        return replace(self, keyframe=reference, motion_evidence=evidence, shutter=shutter)

    def recorrected(self, change: CorrectionChange, config: PyramidConfig) -> "OdometryState":
        """Return the state for a new correction of vignetting and depth bias.

        All keyframes and records are converted to the new correction. The residual history is
        cleared, because the noise may differ from now on.
        """
        keyframe, mapped = self.keyframe, self.mapping_keyframe
        return replace(
            self,
            database=self.database.recorrected(change),
            keyframe=None if keyframe is None else keyframe.recorrected(change, config),
            mapping_keyframe=None if mapped is None else mapped.recorrected(change),
            history=ResidualHistory(),
            shutter=self.shutter.recorrected(),
        )

    def informed(
        self, camera: CameraKnowledge, pyramid: PyramidConfig, config: ShutterConfig
    ) -> "OdometryState":
        """Return the state with new estimates of the self-calibration, for the next frame.

        Frames are compensated with the current shutter timing. If the reference was compensated
        with another timing, the reference is compensated again. Otherwise, it would be distorted
        relative to the frames.

        Args:
            camera: New estimates of the self-calibration, such as the shutter timing.
            pyramid: Settings of the pyramid.
            config: Settings of the shutter.
        """
        keyframe, shutter = self.keyframe, self.shutter.informed(camera.timing, config)
        state = replace(self, shutter=shutter)
        if keyframe is None:
            return state
        used = ShutterTiming() if keyframe.motion is None else keyframe.motion.timing
        velocity = shutter.reference_velocity
        is_known = velocity is not None or keyframe.motion is not None
        if not is_known or not shutter.timing.differs(used, config.relinearized_s):
            return state
        known = np.zeros(6) if velocity is None else velocity
        return replace(state, keyframe=keyframe.retimed(shutter.timing, known, pyramid))

    def _against(self, keyframe: ReferenceKeyframe, T_odom_mapped: np.ndarray) -> "OdometryState":
        return replace(
            self,
            keyframe=keyframe,
            mapping_keyframe=None,
            frames_since_keyframe=0,
            T_odom_last_mapped=T_odom_mapped,
            motion_evidence=self.motion_evidence and self.motion_evidence.of_new_keyframe(),
            shutter=self.shutter.with_new_reference(),
        )


def pack(state: OdometryState) -> dict[str, Any]:
    """Return the state as arrays and plain values, for a checkpoint.

    The image pyramid of a keyframe is not packed; `unpack` computes it from gray image and depth.
    """
    return {
        "places": [record.pack() for record in state.database.all],
        "keyframe": None if state.keyframe is None else state.keyframe.pack(),
        "supporting": None if state.mapping_keyframe is None else state.mapping_keyframe.pack(),
        "motion": asdict(state.motion),
        "history": asdict(state.history),
        "status": state.status.value,
        "frames_since_keyframe": state.frames_since_keyframe,
        "next_id": state.next_id,
        "origin": state.origin.value,
        "trusted": state.trusted_thumbnail,
        "searches": state.relocalization_count,
        "submaps": state.submaps.pack(),
        "T_odom_mapped": state.T_odom_last_mapped,
        "dynamic_mask": _bits(state.dynamic_mask),
        "suspicion": state.motion_evidence
        and (_bits(state.motion_evidence.contradicts), state.motion_evidence.gone),
        "anchor": state.dead_reckoning_start and state.dead_reckoning_start.pack(),
        "shutter": state.shutter.pack(),
    }


def unpack(values: dict[str, Any], config: PyramidConfig) -> OdometryState:
    """Return the state from its packed form; `config` must be unchanged since packing."""
    keyframe, evidence, dynamic_mask = (
        values["keyframe"],
        values["suspicion"],
        values["dynamic_mask"],
    )
    mapping_keyframe, anchor = values["supporting"], values["anchor"]
    return OdometryState(
        database=KeyframeDatabase(
            tuple(KeyframeRecord.unpack(record) for record in values["places"])
        ),
        keyframe=None if keyframe is None else ReferenceKeyframe.unpack(keyframe, config),
        mapping_keyframe=None
        if mapping_keyframe is None
        else KeyframeRecord.unpack(mapping_keyframe),
        motion=ConstantVelocity(**values["motion"]),
        history=ResidualHistory(
            **{name: tuple(noise) for name, noise in values["history"].items()}
        ),
        status=TrackingStatus(values["status"]),
        frames_since_keyframe=values["frames_since_keyframe"],
        next_id=values["next_id"],
        origin=KeyframeOrigin(values["origin"]),
        trusted_thumbnail=values["trusted"],
        relocalization_count=values["searches"],
        submaps=Submaps.unpack(values["submaps"]),
        T_odom_last_mapped=values["T_odom_mapped"],
        dynamic_mask=None if dynamic_mask is None else _mask(dynamic_mask),
        motion_evidence=None
        if evidence is None
        else MotionEvidence(_mask(evidence[0]), evidence[1]),
        dead_reckoning_start=None if anchor is None else DeadReckoningStart.unpack(anchor),
        # A state of an earlier version has no shutter.
        shutter=ShutterState.unpack(values["shutter"]) if "shutter" in values else ShutterState(),
    )


def _bits(mask: np.ndarray | None) -> dict[str, Any] | None:
    """Pack a mask [H, W] bool to one bit per pixel, since it is saved with each frame."""
    return None if mask is None else {"bits": np.packbits(mask), "shape": list(mask.shape)}


def _mask(packed: dict[str, Any]) -> np.ndarray:
    height, width = packed["shape"]
    count = height * width
    return np.unpackbits(packed["bits"], count=count).reshape(height, width).astype(bool)
