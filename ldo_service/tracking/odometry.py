"""RGB-D odometry: each frame's pose from direct alignment to the last keyframe.

    for frame in frames:
        tracked = odometry.track(frame)
        if tracked.wants_keyframe:
            odometry.make_keyframe(frame, tracked)

The caller decides whether there is room for a keyframe; without one, tracking goes on against the
last. Conventions: `ldo_service.geometry`.
"""

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3

from . import snapshot
from .align import AlignConfig, Alignment
from .candidates import Candidate, attempt, best, compared
from .features import FeatureConfig, FeaturePose, Features, detect, estimate_pose
from .judgement import History, JudgementConfig, Status, judge, strict
from .keyframes import Keyframe, KeyframeConfig, is_due
from .motion import Motion, extent
from .pyramid import Pyramid, PyramidConfig, pyramid_of

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    pyramid: PyramidConfig = PyramidConfig()
    align: AlignConfig = AlignConfig()
    features: FeatureConfig = FeatureConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    judgement: JudgementConfig = JudgementConfig()
    large_motion: float = 0.05  # image widths per frame: 2 pixels of the coarsest level
    agreement_rad: float = 0.06  # features against direct: 3 x the median error of ORB-PnP poses
    memory: int = 8  # keyframes kept for relocalisation; older places are the loop closer's
    relocalisation_attempts: int = 2  # direct alignments per lost frame, the best PnP poses first

    def __post_init__(self) -> None:
        if self.memory < 1 or self.relocalisation_attempts < 1:
            raise ConfigError("memory and relocalisation_attempts must be at least 1.")
        if not (self.large_motion > 0 and self.agreement_rad > 0):
            raise ConfigError("large_motion and agreement_rad must be positive.")


@dataclass(frozen=True, slots=True)
class Tracked:
    """Where a frame was taken. While LOST the pose is the last trusted one.

    information [6, 6] is that of T_keyframe_camera * exp(xi), rotation rad then translation m;
    zero while LOST.
    """

    T_odom_camera: np.ndarray  # [4, 4]
    T_keyframe_camera: np.ndarray  # [4, 4]
    keyframe_index: int  # `RgbdFrame.index` of the keyframe
    status: Status
    method: str  # "first", "direct", "features", "relocalised", "none"
    wants_keyframe: bool
    information: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    inlier_fraction: float = 0.0  # smaller of the photometric and the geometric
    intensity_sigma: float = 0.0  # photometric residual, grey levels
    depth_noise_scale: float = 0.0  # geometric residual, times the sensor model
    overlap: float = 0.0  # visible fraction of the keyframe's surface
    iterations: int = 0


class Odometry:
    """Tracks one camera. Deterministic: equal frames give bitwise equal results."""

    def __init__(self, config: OdometryConfig | None = None) -> None:
        self.config = config or OdometryConfig()
        self._memory: tuple[Keyframe, ...] = ()  # oldest first
        self._keyframe: Keyframe | None = None  # the one tracked against, usually the newest
        self._motion = Motion()
        self._history = History()
        self._status = Status.OK
        self._frames_since_keyframe = 0
        self._view: tuple[RgbdFrame, Pyramid] | None = None  # of the last frame

    def track(self, frame: RgbdFrame) -> Tracked:
        """The pose of a frame. Never raises for what the frame shows: it may be blank."""
        view = self._viewed(frame)
        if self._keyframe is None:
            return self._first(frame, view)
        self._frames_since_keyframe += 1
        candidate, status = self._followed(frame, view)
        if status is Status.LOST:
            found = self._relocalised(view)
            if found is None:
                return self._lost(candidate.alignment)
            self._keyframe, candidate = found
            status = Status.OK
        return self._accepted(frame, candidate, status)

    def make_keyframe(self, frame: RgbdFrame, tracked: Tracked) -> None:
        """Track against this frame, the one just tracked, from now on."""
        self._keyframe = Keyframe(self._viewed(frame), tracked.T_odom_camera, frame.index)
        self._memory = (*self._memory, self._keyframe)[-self.config.memory :]
        self._frames_since_keyframe = 0

    def state(self) -> dict[str, Any]:
        """All that the next frames depend on, in arrays and plain values; see `restore`."""
        return snapshot.taken(
            self._memory,
            self._keyframe,
            self._motion,
            self._history,
            self._status,
            self._frames_since_keyframe,
        )

    def restore(self, state: dict[str, Any]) -> None:
        """Continue where `state` was taken: the next frames give bitwise equal results."""
        (
            self._memory,
            self._keyframe,
            self._motion,
            self._history,
            self._status,
            self._frames_since_keyframe,
        ) = snapshot.opened(state, self.config.pyramid)
        self._view = None

    def _viewed(self, frame: RgbdFrame) -> Pyramid:
        if self._view is None or self._view[0] is not frame:
            self._view = (frame, pyramid_of(frame, self.config.pyramid))
        return self._view[1]

    def _first(self, frame: RgbdFrame, view: Pyramid) -> Tracked:
        measured = float(np.mean(view.levels[0].depth_m > 0))
        usable = measured >= self.config.judgement.min_paired
        self._motion = Motion(stamp_ns=frame.stamp_ns)
        status, method = (Status.OK, "first") if usable else (Status.LOST, "none")
        return Tracked(np.eye(4), np.eye(4), frame.index, status, method, usable)

    def _followed(self, frame: RgbdFrame, view: Pyramid) -> tuple[Candidate, Status]:
        """Alignment to the current keyframe: by prediction, and by all means if that is poor."""
        keyframe = self._current
        T_keyframe_odom = se3.inverse(keyframe.T_odom_keyframe)
        predicted = T_keyframe_odom @ self._motion.predicted(frame.stamp_ns)
        resting = T_keyframe_odom @ self._motion.T_odom_camera
        candidate = attempt(keyframe, view, predicted, "direct", self.config.align)
        status = self._judged(candidate)
        if status is Status.OK and not self._is_large(candidate, resting, view):
            return candidate, status
        candidates = [candidate, attempt(keyframe, view, resting, "direct", self.config.align)]
        pose = self._feature_pose(keyframe, detect(view, self.config.features), view)
        if pose is None:
            candidate = self._best(candidates, view)
            return candidate, self._judged(candidate)
        T_keyframe_camera = se3.inverse(pose.T_camera_reference)
        candidates.append(
            attempt(keyframe, view, T_keyframe_camera, "features", self.config.align)
        )
        candidate = compared(
            self._best(candidates, view),
            T_keyframe_camera,
            keyframe.reference.median_depth_m,
            self.config.agreement_rad,
        )
        return candidate, self._judged(candidate)

    @property
    def _current(self) -> Keyframe:
        assert self._keyframe is not None
        return self._keyframe

    def _judged(self, candidate: Candidate) -> Status:
        return judge(
            candidate.alignment,
            candidate.features_agree,
            self._history,
            self._status,
            self.config.judgement,
        )

    def _best(self, candidates: list[Candidate], view: Pyramid) -> Candidate:
        return best(candidates, self._current, view, self.config.align)

    def _is_large(self, candidate: Candidate, resting: np.ndarray, view: Pyramid) -> bool:
        """Whether the image moved so far since the last frame that a minimum may be a wrong one."""
        moved = se3.inverse(resting) @ candidate.alignment.T_reference_camera
        shift_rad = extent(moved, self._current.reference.median_depth_m)
        return shift_rad * view.camera.fx > self.config.large_motion * view.camera.width

    def _feature_pose(
        self, keyframe: Keyframe, features: Features, view: Pyramid
    ) -> FeaturePose | None:
        config = self.config.features
        return estimate_pose(keyframe.features(config), features, view.camera, config)

    def _relocalised(self, view: Pyramid) -> tuple[Keyframe, Candidate] | None:
        """The remembered keyframe that this view surely shows, and the alignment to it."""
        features = detect(view, self.config.features)
        poses = [(k, self._feature_pose(k, features, view)) for k in reversed(self._memory)]
        found = [(k, pose) for k, pose in poses if pose is not None]
        found.sort(key=lambda pair: -pair[1].inliers)  # stable: of equals, the newest
        for keyframe, pose in found[: self.config.relocalisation_attempts]:
            T_keyframe_camera = se3.inverse(pose.T_camera_reference)
            candidate = compared(
                attempt(keyframe, view, T_keyframe_camera, "relocalised", self.config.align),
                T_keyframe_camera,
                keyframe.reference.median_depth_m,
                self.config.agreement_rad,
            )
            limits = strict(self.config.judgement)
            verdict = judge(
                candidate.alignment, candidate.features_agree, self._history, Status.LOST, limits
            )
            if verdict is Status.OK:
                return keyframe, candidate
        return None

    def _lost(self, alignment: Alignment) -> Tracked:
        self._report(Status.LOST)
        self._motion = self._motion.stopped()
        T_odom_camera = self._motion.T_odom_camera
        return Tracked(
            T_odom_camera,
            se3.inverse(self._current.T_odom_keyframe) @ T_odom_camera,
            self._current.index,
            Status.LOST,
            "none",
            wants_keyframe=False,
            intensity_sigma=alignment.intensity_sigma,
            depth_noise_scale=alignment.depth_noise_scale,
            overlap=alignment.overlap,
            iterations=alignment.iterations,
        )

    def _accepted(self, frame: RgbdFrame, candidate: Candidate, status: Status) -> Tracked:
        alignment, keyframe = candidate.alignment, self._current
        T_odom_camera = se3.orthonormalised(
            keyframe.T_odom_keyframe @ alignment.T_reference_camera
        )
        was_lost = self._status is Status.LOST
        self._report(status)
        self._motion = self._motion.moved_to(T_odom_camera, frame.stamp_ns)
        if was_lost or status is not Status.OK:
            self._motion = self._motion.stopped()
        if status is Status.OK:
            self._history = self._history.extended(alignment, self.config.judgement)
        return Tracked(
            T_odom_camera,
            alignment.T_reference_camera,
            keyframe.index,
            status,
            candidate.method,
            wants_keyframe=status is Status.OK
            and is_due(
                alignment.T_reference_camera,
                alignment.overlap,
                keyframe.reference.median_depth_m,
                self._frames_since_keyframe,
                self.config.keyframes,
            ),
            information=alignment.information,
            inlier_fraction=min(alignment.photometric_inliers, alignment.geometric_inliers),
            intensity_sigma=alignment.intensity_sigma,
            depth_noise_scale=alignment.depth_noise_scale,
            overlap=alignment.overlap,
            iterations=alignment.iterations,
        )

    def _report(self, status: Status) -> None:
        if status is not self._status:
            log.info("tracking %s, was %s (keyframe %d)", status, self._status, self._current.index)
        self._status = status
