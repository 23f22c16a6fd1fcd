"""Tracking of the camera pose in RGB-D frames.

Topics, their messages, the delivery policy of each input (with its queue length), and notes:

in   frame/rgbd       FrameRgbd        Latest(1)    a late frame is worth less than the next one
in   graph/correction GraphCorrection  Latest(1)    has all poses, so the newest suffices
in   odometry/prior   OdometryPrior    Latest(64)   at 200 Hz, 64 poses cover 0.3 s, the
                                                    time in which a frame is tracked
in   detection/boxes  DetectionBoxes   Latest(1)    dynamic objects are masked for tracking
out  pose/tracked     TrackedPose                   one for every tracked frame
out  keyframe/new     Keyframe                      made only if the mapper has granted credit
out  keyframe/measurements  KeyframeMeasurements    each keyframe without its images

The actor converts messages, buffers the odometry prior and counts results. `Odometry.process`
tracks a frame in one call. If `TrackerConfig.localize` names a finished run, a `Localizer` replaces
the odometry. The localizer makes no keyframes, so the mapper and the optimizer are idle and the map
does not change. Subscribers receive the same pose messages in both cases.
"""

import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.calibration.correction import CameraCorrection, read_correction
from ldo_service.calibration.self_calibration import SelfCalibration, SelfCalibrationConfig
from ldo_service.conversions.frames import (
    frame_from_message,
    keyframe_measurements_message,
    keyframe_message,
    tracked_pose_message,
)
from ldo_service.conversions.poses import map_correction_of, pose_from_message
from ldo_service.detection.dynamic_classes import Box
from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.runtime import Actor, In, Latest, Out
from ldo_service.schemas import (
    Detection,
    DetectionBoxes,
    FrameRgbd,
    GraphCorrection,
    Keyframe,
    KeyframeMeasurements,
    OdometryPrior,
    TrackedPose,
)
from ldo_service.schemas.message import decode, encode
from ldo_service.schemas.topics import (
    DETECTION_BOXES,
    FRAME_RGBD,
    GRAPH_CORRECTION,
    KEYFRAME_MEASUREMENTS,
    KEYFRAME_NEW,
    ODOMETRY_PRIOR,
    POSE_TRACKED,
)
from ldo_service.tracking.localizer import Localizer, load_keyframe_database
from ldo_service.tracking.odometry import Odometry
from ldo_service.tracking.odometry_config import OdometryConfig
from ldo_service.tracking.odometry_prior import OdometryPriorBuffer, PriorCheck
from ldo_service.tracking.shutter import ShutterState
from ldo_service.tracking.tracking_quality import TrackingStatus
from ldo_service.tracking.tracking_result import TrackingResult

log = logging.getLogger(__name__)

# Maximum difference of a configured quaternion's norm from 1. Configured values often have only
# four digits; they are normalized.
UNIT_WITHIN = 1e-3
# Number of consecutive frames without a prior before the warning: a second of frames, longer than a
# short gap.
MISSED_PRIOR_WARNING_COUNT = 30
# Entries of the odometry's state that are saved as separate parts.
OWN_PARTS = "keyframe", "supporting"


@dataclass(frozen=True, slots=True)
class CameraExtrinsics:
    """Pose of the camera on the robot: T_base_camera.

    The camera frame has x right, y down and z forward. If the base frame has x forward and z up
    (REP-103), the quaternion (w x y z) of a forward-looking camera is 0.5 -0.5 0.5 -0.5.
    """

    # Camera center in the base frame, meters.
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # The identity: base and camera coincide.
    quaternion_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not np.isfinite((*self.translation_m, *self.quaternion_wxyz)).all():
            raise ConfigError(
                f"tracker.T_base_camera.translation_m={list(self.translation_m)} and "
                f"quaternion_wxyz={list(self.quaternion_wxyz)} must be finite."
            )
        norm = float(np.linalg.norm(self.quaternion_wxyz))
        if abs(norm - 1.0) > UNIT_WITHIN:
            raise ConfigError(
                f"tracker.T_base_camera.quaternion_wxyz={list(self.quaternion_wxyz)} has norm "
                f"{norm:.4g}, but must have norm 1. The order is w x y z."
            )

    def matrix(self) -> np.ndarray:
        """Return T_base_camera [4, 4]."""
        return se3.from_quaternion(np.array(self.translation_m), np.array(self.quaternion_wxyz))


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Parameters of the tracker."""

    T_base_camera: CameraExtrinsics = field(default_factory=CameraExtrinsics)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    calibration: SelfCalibrationConfig = field(default_factory=SelfCalibrationConfig)
    # Folder of a finished run. The tracker localizes in the map of this run, which does not change.
    # Empty: the tracker makes keyframes for a new map.
    localize: str = ""
    # Folder of a finished run of the same camera, whose calibration this run starts with. Empty:
    # the camera is unknown.
    calibration_run: str = ""
    hold_out: int = 0  # Every n-th frame is tracked but not mapped, to evaluate the map; 0: none.

    def __post_init__(self) -> None:
        if self.hold_out < 0 or self.hold_out == 1:
            raise ConfigError(f"tracker.hold_out={self.hold_out} must be 0 or at least 2 frames.")


class Tracker(Actor):
    """Actor that tracks frames against the reference keyframe.

    Graph corrections update the map poses of the tracker's keyframes.
    """

    name = "tracker"
    inputs = (
        In(FRAME_RGBD, Latest(1)),
        In(GRAPH_CORRECTION, Latest(1)),
        In(ODOMETRY_PRIOR, Latest(64)),
        In(DETECTION_BOXES, Latest(1)),
    )
    outputs = (
        Out(POSE_TRACKED),
        Out(KEYFRAME_NEW, is_nonblocking=True),
        Out(KEYFRAME_MEASUREMENTS),
    )
    is_prompt = True

    def __init__(self, config: TrackerConfig | None = None) -> None:
        super().__init__()
        self.config = config or TrackerConfig()
        self._T_base_camera = self.config.T_base_camera.matrix()
        self._odometry = _make_odometry(self.config, self._T_base_camera)
        self._calibration = _make_calibration(self.config)
        self._shutter = ShutterState()  # Timing of the shutter after the last frame.
        self._correction = b""  # The last correction, encoded.
        self._prior = OdometryPriorBuffer()
        # Numbers of keyframes that were made, not made for lack of credit, and reused.
        self._made = self._without_room = self._reused = 0
        # Numbers of frames aligned, and of those in which color and depth contradicted each other.
        self._aligned = self._contradictory = 0
        self._lost = 0  # Consecutive LOST frames up to the last one.
        # Numbers of prior poses by outcome of their check.
        self._prior_checks: Counter[PriorCheck] = Counter()
        # Numbers of frames with and without a prior, since the first pose of the prior.
        self._with_prior = self._without_prior = 0
        self._missed = 0  # Consecutive frames without a prior.
        # Cached parts of the state; `snapshot` adds the prior, which also changes between frames.
        self._parts: dict[str, Any] | None = None

    def handle(
        self, message: FrameRgbd | GraphCorrection | OdometryPrior | DetectionBoxes
    ) -> Iterator[TrackedPose | Keyframe | KeyframeMeasurements]:
        """Yield the pose of a frame; if the frame becomes a keyframe, yield the keyframe first."""
        if isinstance(message, OdometryPrior):
            self._take_prior(message)
            return
        self._parts = None
        if isinstance(message, GraphCorrection):
            self._correct(message)
        elif isinstance(message, DetectionBoxes):
            boxes = [_box(detection) for detection in message.detections]
            self._odometry.mask_dynamic_objects(message.keyframe, boxes)
        else:
            yield from self._track(frame_from_message(message))

    def _track(self, raw: RgbdFrame) -> Iterator[TrackedPose | Keyframe | KeyframeMeasurements]:
        """Track a frame; if it becomes a keyframe, yield the keyframe first, then the pose.

        The color and the depth of the keyframe are corrected by the self-calibration. They are also
        compensated for the motion of the camera during the frame.
        """
        correction = self._calibration.correction
        frame = correction.applied(raw)
        hold_out = self.config.hold_out
        is_held_out = hold_out > 0 and frame.index % hold_out == hold_out - 1
        may_map = not is_held_out and self.has_credit(KEYFRAME_NEW)
        known = self._calibration.knowledge
        result = self._odometry.process(frame, self._prior, may_map=may_map, camera=known)
        self._shutter = result.shutter
        self._count(frame, result, is_held_out)
        is_lost = result.status is TrackingStatus.LOST
        T_odom_camera, motion = None if is_lost else result.T_odom_camera, result.motion
        change = self._calibration.observe(raw, T_odom_camera, motion)
        if change is not None:
            self._odometry.recorrect(change)
        if result.awaits_mapping:
            return  # Odometry starts with a later frame that may be mapped.
        if result.keyframe is not None:
            mapped = correction.applied(raw, keeps_clipped=False)
            if motion is not None:
                mapped = motion.compensated(mapped)
            correction = replace(correction, timing=result.shutter.timing)
            keyframe = keyframe_message(mapped, result, result.keyframe, correction)
            yield keyframe
            yield keyframe_measurements_message(keyframe)
        yield tracked_pose_message(frame, result, self._T_base_camera)

    def _count(self, frame: RgbdFrame, result: TrackingResult, is_held_out: bool) -> None:
        self._made += result.keyframe is not None
        self._reused += result.reused_keyframe is not None
        self._without_room += result.denied_keyframe is not None and not is_held_out
        self._aligned += result.information.any() and result.status is not TrackingStatus.LOST
        self._contradictory += result.is_contradictory
        self._lost = self._lost + 1 if result.status is TrackingStatus.LOST else 0
        if not self._prior.poses:
            return
        self._with_prior += result.has_prior
        self._without_prior += not result.has_prior
        self._missed = 0 if result.has_prior else self._missed + 1
        if self._missed == MISSED_PRIOR_WARNING_COUNT:
            log.warning(
                "tracker: %d frames in a row had no odometry/prior; the newest pose of the prior "
                "is %.3f s older than the last frame. Check that odometry/prior is still "
                "published, and that camera and odometry use one clock.",
                self._missed, 1e-9 * (frame.stamp_ns - self._prior.poses[-1].stamp_ns),
            )  # fmt: skip

    def _take_prior(self, message: OdometryPrior) -> None:
        T_odom_base = pose_from_message(message.T_prior_base)
        config = self.config.odometry.prior
        self._prior, check = self._prior.added(message.stamp_ns, T_odom_base, config)
        self._prior_checks[check] += 1
        if check is not PriorCheck.FOLLOWS and self._prior_checks[check] == 1:
            log.warning(
                "tracker: the pose on odometry/prior with stamp %d ns %s. Further such poses are "
                "only counted. If many follow, check the program that publishes odometry/prior.",
                message.stamp_ns, check,
            )  # fmt: skip

    def _correct(self, message: GraphCorrection) -> None:
        body = encode(message)
        if self._odometry.correct(map_correction_of(decode(body, GraphCorrection))):
            self._correction = body

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """Return the state in parts; only parts that have changed are written to disk.

        Each stored keyframe is a part of its own, which never changes.
        """
        if self._parts is None:
            self._parts = self._tracked_parts()
        return {**self._parts, "prior": self._prior.pack()}

    def _tracked_parts(self) -> dict[str, Any]:
        """Return all parts of the tracker's state for a snapshot."""
        state = self._odometry.snapshot()
        records = {record["id"]: record for record in state.pop("places")}
        state["order"] = [*records]  # The most recently used keyframe comes last.
        own = {name: state.pop(name) for name in OWN_PARTS}
        fix = {"fix": state.pop("fix")} if "fix" in state else {}
        poses, localize = state.pop("poses"), self.config.localize
        return {
            **{f"place_{number}": record for number, record in records.items()},
            **own,
            "graph_correction": self._correction,
            "now": {"odometry": state, "poses": poses, "localize": localize},
            "prior": self._prior.pack(),
            **{f"calibration_{k}": part for k, part in self._calibration.snapshot().items()},
            **fix,
        }

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        """Continue from a snapshot.

        Raises:
            ConfigError: The snapshot was saved with another value of `localize`.
        """
        now = state["now"]
        if now["localize"] != self.config.localize:
            raise ConfigError(
                f"the saved state is of a service with --localize {now['localize'] or '(none)'}, "
                f"but this service has --localize {self.config.localize or '(none)'}. Choose "
                "another folder with --state."
            )
        records = [state[f"place_{number}"] for number in now["odometry"]["order"]]
        own = {name: state[name] for name in (*OWN_PARTS, "fix") if name in state}
        self._correction = state["graph_correction"]
        correction = decode(self._correction, GraphCorrection) if self._correction else None
        self._odometry.restore(
            {**now["odometry"], **own, "places": records, "poses": now["poses"]},
            None if correction is None else map_correction_of(correction),
        )
        self._prior, self._parts = OdometryPriorBuffer.unpack(state["prior"]), None
        prefix = "calibration_"
        saved = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        if saved:  # A state of an earlier version has no calibration.
            self._calibration.restore(saved)
        if "shutter" in now["odometry"]:
            self._shutter = ShutterState.unpack(now["odometry"]["shutter"])

    def metrics(self) -> dict[str, float]:
        """Return counters of keyframes, frames and prior poses."""
        refused = self._prior_checks[PriorCheck.LATE] + self._prior_checks[PriorCheck.BROKEN]
        restarts = self._prior_checks[PriorCheck.RESTARTED] + self._prior_checks[PriorCheck.JUMPED]
        return {
            "keyframes": self._made,
            "keyframes_without_credit": self._without_room,
            "keyframes_reused": self._reused,
            "frames_aligned": int(self._aligned),
            # Frames in which color and depth contradicted each other.
            "frames_contradictory": self._contradictory,
            "frames_lost_in_a_row": self._lost,  # 0 while tracking is not lost.
            "frames_with_prior": self._with_prior,
            "frames_without_prior": self._without_prior,  # Since the first pose of the prior.
            "prior_rejected": refused,
            "prior_restarts": restarts,
            **self._odometry.aligner.device.metrics(),
            **self._calibration.metrics(),
            **self._calibration.evidence(),
            **self._shutter.metrics(),
        }


def _make_odometry(config: TrackerConfig, T_base_camera: np.ndarray) -> Odometry:
    """Return odometry that makes keyframes, or a localizer in the map of a finished run.

    Raises:
        DataError: The folder of the run has no usable keyframe database.
    """
    shutter = config.odometry.shutter
    if shutter.is_on:
        shutter = replace(shutter, initial=_known_correction(config).timing)
    odometry = replace(config.odometry, shutter=shutter)
    if not config.localize:
        return Odometry(odometry, T_base_camera)
    return Localizer(load_keyframe_database(Path(config.localize)), odometry, T_base_camera)


def _make_calibration(config: TrackerConfig) -> SelfCalibration:
    """Return the self-calibration, which starts with the correction of a finished run, if any.

    Raises:
        DataError: The folder of the run has no usable keyframes.json.
    """
    correction = _known_correction(config)
    if config.localize:
        return SelfCalibration.finished(correction)
    if config.calibration_run:
        return SelfCalibration.continued(correction, config.calibration)
    return SelfCalibration(config.calibration)


def _known_correction(config: TrackerConfig) -> CameraCorrection:
    """Return the last correction of the finished run that the configuration names, if any."""
    folder = config.localize or config.calibration_run
    if not folder:
        return CameraCorrection()
    try:
        return read_correction(Path(folder))
    except DataError as error:
        if config.localize:
            raise
        raise DataError(f"tracker.calibration_run={folder} cannot be used: {error}") from error


def _box(detection: Detection) -> Box:
    """Convert a detection to a box; its origin is a corner of the first pixel, not the center."""
    x0, y0, x1, y1 = (edge + 0.5 for edge in detection.box_px)
    return Box(detection.label, x0, y0, x1, y1)
