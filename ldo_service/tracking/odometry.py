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
from .candidates import Candidate, CandidateConfig, attempt, best
from .features import FeatureConfig, detect, estimate_pose
from .judgement import History, JudgementConfig, Status, judge
from .keyframes import Keyframe, KeyframeConfig, is_due
from .motion import Motion, extent
from .pyramid import Pyramid, PyramidConfig, pyramid_of
from .relocalisation import RelocalisationConfig, relocalise

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)
    judgement: JudgementConfig = field(default_factory=JudgementConfig)
    large_motion: float = 0.05  # image widths per frame: 2 pixels of the coarsest level

    def __post_init__(self) -> None:
        if not self.large_motion > 0:
            raise ConfigError(f"large_motion={self.large_motion:g} must be positive.")


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
        self._memory = (*self._memory, self._keyframe)[-self.config.relocalisation.memory :]
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
        candidate = self._attempted(view, predicted)
        status = self._judged(candidate)
        if status is Status.OK and not self._is_large(candidate, resting, view):
            return candidate, status
        candidate = self._best([candidate, self._attempted(view, resting)], view)
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

    def _attempted(
        self, view: Pyramid, T_keyframe_camera: np.ndarray, method: str = "direct"
    ) -> Candidate:
        return attempt(self._current, view, T_keyframe_camera, method, self.config.align)

    def _best(self, candidates: list[Candidate], view: Pyramid) -> Candidate:
        """The best of these and of what features suggest."""
        config, keyframe = self.config, self._current
        seen = detect(view, config.features)
        kept = keyframe.features(config.features)
        pose = estimate_pose(kept, seen, view.camera, config.features)
        if pose is not None:
            guess = se3.inverse(pose.T_camera_reference)
            candidates = [*candidates, self._attempted(view, guess, "features")]
        return best(candidates, pose, keyframe, view, config.candidates, config.align)

    def _is_large(self, candidate: Candidate, resting: np.ndarray, view: Pyramid) -> bool:
        """Whether the image moved so far since the last frame that a minimum may be a wrong one."""
        moved = se3.inverse(resting) @ candidate.alignment.T_reference_camera
        shift_rad = extent(moved, self._current.reference.median_depth_m)
        return shift_rad * view.camera.fx > self.config.large_motion * view.camera.width

    def _relocalised(self, view: Pyramid) -> tuple[Keyframe, Candidate] | None:
        config = self.config
        return relocalise(
            self._memory,
            view,
            self._history,
            config.judgement,
            config.features,
            config.align,
            config.relocalisation,
        )

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
        T_odom_camera = se3.orthonormalised(keyframe.T_odom_keyframe @ alignment.T_reference_camera)
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
