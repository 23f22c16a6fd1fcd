"""Actors that err by what is known: odometry that drifts, and places taken for others."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np

from ldo_service.actors.loop_closer import LoopCloser, LoopCloserConfig
from ldo_service.actors.topology import ActorParameters, make_actors
from ldo_service.actors.tracker import Tracker, TrackerConfig
from ldo_service.conversions.poses import relative_pose_to_message
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.geometry.keyframe_poses import RelativePose
from ldo_service.runtime import Actor
from ldo_service.schemas import (
    DetectionBoxes,
    GraphCorrection,
    Keyframe,
    LoopCandidate,
    LoopClosure,
)
from ldo_service.tracking import Odometry, OdometryConfig
from ldo_service.tracking.map_frame import MapCorrection, MapFrame
from ldo_service.tracking.odometry_prior import OdometryPriorBuffer
from ldo_service.tracking.tracking_result import TrackedFrame, TrackingResult

UP_ODOM = np.array([0.0, -1.0, 0.0])  # of a camera held level at the start
ASIDE_ODOM = np.array([1.0, 0.0, 0.0])  # level
SURE = np.diag(np.repeat([1e-3, 2e-3], 3) ** -2.0)  # rad and m: as images refine a true closure


@dataclass(frozen=True, slots=True)
class Drift:
    """What is added to every motion between two frames."""

    scale: float = 0.01  # share of the distance, along the way
    aside: float = 0.0  # share of the distance, always to one side of the world
    turn_rad_per_m: float = np.radians(0.5)  # about the vertical

    def of(self, T_odom_before: np.ndarray, T_before_now: np.ndarray) -> np.ndarray:
        """T_before_now [4, 4] as odometry that drifts says it."""
        T, way_m = T_before_now.copy(), np.linalg.norm(T_before_now[:3, 3])
        T[:3, 3] *= 1 + self.scale
        T[:3, 3] += self.aside * way_m * (T_odom_before[:3, :3].T @ ASIDE_ODOM)
        up_now = (T_odom_before @ T_before_now)[:3, :3].T @ UP_ODOM
        return T @ se3.exp(np.r_[self.turn_rad_per_m * way_m * up_now, 0, 0, 0])


class DriftingOdometry(Odometry):
    """Tracks as ever, and says that the camera went elsewhere. For a camera that is never lost."""

    def __init__(self, config: OdometryConfig, drift: Drift) -> None:
        super().__init__(config)
        self._drift = drift
        self._right: TrackingResult | None = None  # The last frame, as it was tracked.
        self._T_drifted = np.eye(4)  # T_odom_camera, as it is told.
        self._told: dict[int, np.ndarray] = {}  # T_odom_keyframe, likewise.
        self._told_map = MapFrame()

    def process(
        self, frame: RgbdFrame, prior: OdometryPriorBuffer | None = None, *, may_map: bool = True
    ) -> TrackingResult:
        before, right = self._right, super().process(frame, prior, may_map=may_map)
        self._right = right
        if before is not None:
            T_before_now = se3.inverse(before.T_odom_camera) @ right.T_odom_camera
            T_step = self._drift.of(before.T_odom_camera, T_before_now)
            self._T_drifted = se3.orthonormalize(self._T_drifted @ T_step)
        return self._as_told(right)

    def correct(self, correction: MapCorrection) -> bool:
        self._told_map.correct(correction)
        return super().correct(correction)

    def _as_told(self, right: TrackingResult) -> TrackingResult:
        keyframe, reference = right.keyframe, right.reference
        T_reference_camera = np.eye(4)
        if reference in self._told:
            T_reference_camera = se3.inverse(self._told[reference]) @ self._T_drifted
        if keyframe is not None:
            self._told[keyframe.id] = self._T_drifted
            told = TrackedFrame(
                right.status,
                right.pose_source,
                self._T_drifted,
                T_reference_camera,
                None if reference == keyframe.id else reference,
                keyframe.submap,
            )
            self._told_map.add_keyframe(keyframe.id, told, self.reference)
            keyframe = replace(keyframe, window=tuple(map(self._as_told_of, keyframe.window)))
        return replace(
            right,
            T_odom_camera=self._T_drifted,
            T_reference_camera=T_reference_camera,
            T_map_odom=se3.orthonormalize(self._told_map.T_map_odom(reference)),
            keyframe=keyframe,
        )

    def _as_told_of(self, right: RelativePose) -> RelativePose:
        return replace(right, T_a_b=se3.inverse(self._told[right.a]) @ self._told[right.b])


class DriftingTracker(Tracker):
    def __init__(self, config: TrackerConfig, drift: Drift) -> None:
        super().__init__(config)
        self._odometry = DriftingOdometry(config.odometry, drift)


class MistakenLoopCloser(LoopCloser):
    """Says of some keyframes, besides what it finds, that they stand beside old ones.

    beside  by keyframe: the old one, and T_old_keyframe [4, 4] that it claims
    """

    def __init__(
        self, config: LoopCloserConfig, beside: Mapping[int, tuple[int, np.ndarray]]
    ) -> None:
        super().__init__(config)
        self._beside = dict(beside)

    def handle(
        self, message: Keyframe | DetectionBoxes | GraphCorrection
    ) -> Iterator[LoopClosure | LoopCandidate]:
        yield from super().handle(message)
        if isinstance(message, Keyframe) and message.keyframe in self._beside:
            old, T_old_keyframe = self._beside[message.keyframe]
            closure = RelativePose(old, message.keyframe, T_old_keyframe, SURE)
            pose = relative_pose_to_message(closure)
            yield LoopClosure(stamp_ns=message.stamp_ns, pose=pose, overlap=0.8, rmse_m=0.005)


@contextmanager
def standing_in(*actors: Actor) -> Iterator[None]:
    """Within, runs over files have these in place of those of the same names."""
    names = {actor.name: actor for actor in actors}

    def made(parameters: ActorParameters) -> Sequence[Actor]:
        return [names.get(actor.name, actor) for actor in make_actors(parameters)]

    with patch("ldo_service.runs.offline.make_actors", made):
        yield
