"""Actors with known errors: drifting odometry and false loop closures."""

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

UP_ODOM = np.array([0.0, -1.0, 0.0])  # Vertical of a camera that starts level.
ASIDE_ODOM = np.array([1.0, 0.0, 0.0])  # Horizontal.
# Deviations in rad and m, those of a true closure that images refine.
INFORMATION = np.diag(np.repeat([1e-3, 2e-3], 3) ** -2.0)


@dataclass(frozen=True, slots=True)
class Drift:
    """Error that is added to every motion between two frames."""

    scale: float = 0.01  # Fraction of the distance, along the motion.
    aside: float = 0.0  # Fraction of the distance, to one side of the world.
    turn_rad_per_m: float = np.radians(0.5)  # Rotation around the vertical axis.

    def of(self, T_odom_before: np.ndarray, T_before_now: np.ndarray) -> np.ndarray:
        """Return T_before_now [4, 4] with drift added."""
        T, way_m = T_before_now.copy(), np.linalg.norm(T_before_now[:3, 3])
        T[:3, 3] *= 1 + self.scale
        T[:3, 3] += self.aside * way_m * (T_odom_before[:3, :3].T @ ASIDE_ODOM)
        up_now = (T_odom_before @ T_before_now)[:3, :3].T @ UP_ODOM
        return T @ se3.exp(np.r_[self.turn_rad_per_m * way_m * up_now, 0, 0, 0])


class DriftingOdometry(Odometry):
    """Odometry with drift added to its poses, for a camera that is never lost."""

    def __init__(self, config: OdometryConfig, drift: Drift) -> None:
        super().__init__(config)
        self._drift = drift
        self._exact: TrackingResult | None = None  # Last result without drift.
        self._T_drifted = np.eye(4)  # T_odom_camera with drift.
        self._T_odom_keyframe: dict[int, np.ndarray] = {}  # T_odom_keyframe by id, with drift.
        self._drifted_map = MapFrame()

    def process(
        self, frame: RgbdFrame, prior: OdometryPriorBuffer | None = None, *, may_map: bool = True
    ) -> TrackingResult:
        before, exact = self._exact, super().process(frame, prior, may_map=may_map)
        self._exact = exact
        if before is not None:
            T_before_now = se3.inverse(before.T_odom_camera) @ exact.T_odom_camera
            T_step = self._drift.of(before.T_odom_camera, T_before_now)
            self._T_drifted = se3.orthonormalize(self._T_drifted @ T_step)
        return self._with_drift(exact)

    def correct(self, correction: MapCorrection) -> bool:
        self._drifted_map.correct(correction)
        return super().correct(correction)

    def _with_drift(self, exact: TrackingResult) -> TrackingResult:
        keyframe, reference = exact.keyframe, exact.reference
        T_reference_camera = np.eye(4)
        if reference in self._T_odom_keyframe:
            T_reference_camera = se3.inverse(self._T_odom_keyframe[reference]) @ self._T_drifted
        if keyframe is not None:
            self._T_odom_keyframe[keyframe.id] = self._T_drifted
            tracked = TrackedFrame(
                exact.status,
                exact.pose_source,
                self._T_drifted,
                T_reference_camera,
                None if reference == keyframe.id else reference,
                keyframe.submap,
            )
            self._drifted_map.add_keyframe(keyframe.id, tracked, self.reference)
            keyframe = replace(
                keyframe, window=tuple(map(self._drifted_measurement, keyframe.window))
            )
        return replace(
            exact,
            T_odom_camera=self._T_drifted,
            T_reference_camera=T_reference_camera,
            T_map_odom=se3.orthonormalize(self._drifted_map.T_map_odom(reference)),
            keyframe=keyframe,
        )

    def _drifted_measurement(self, exact: RelativePose) -> RelativePose:
        return replace(
            exact,
            T_a_b=se3.inverse(self._T_odom_keyframe[exact.a]) @ self._T_odom_keyframe[exact.b],
        )


class DriftingTracker(Tracker):
    """Tracker with drifting odometry."""

    def __init__(self, config: TrackerConfig, drift: Drift) -> None:
        super().__init__(config)
        self._odometry = DriftingOdometry(config.odometry, drift)


class MistakenLoopCloser(LoopCloser):
    """Loop closer that adds given false closures to those that it finds.

    Args:
        config: Parameters of the loop closer.
        false_closures: By keyframe, the old keyframe and the false T_old_keyframe [4, 4].
    """

    def __init__(
        self, config: LoopCloserConfig, false_closures: Mapping[int, tuple[int, np.ndarray]]
    ) -> None:
        super().__init__(config)
        self._false_closures = dict(false_closures)

    def handle(
        self, message: Keyframe | DetectionBoxes | GraphCorrection
    ) -> Iterator[LoopClosure | LoopCandidate]:
        yield from super().handle(message)
        if isinstance(message, Keyframe) and message.keyframe in self._false_closures:
            old, T_old_keyframe = self._false_closures[message.keyframe]
            closure = RelativePose(old, message.keyframe, T_old_keyframe, INFORMATION)
            pose = relative_pose_to_message(closure)
            yield LoopClosure(stamp_ns=message.stamp_ns, pose=pose, overlap=0.8, rmse_m=0.005)


@contextmanager
def replaced_actors(*actors: Actor) -> Iterator[None]:
    """Replace the actors of offline runs by the given ones of the same names."""
    names = {actor.name: actor for actor in actors}

    def make_replaced(parameters: ActorParameters) -> Sequence[Actor]:
        return [names.get(actor.name, actor) for actor in make_actors(parameters)]

    with patch("ldo_service.runs.offline.make_actors", make_replaced):
        yield
