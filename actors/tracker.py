"""Camera pose of each RGB-D frame.                                          actors/tracker.py

in   frame/rgbd         FrameRgbd     Latest(1)   a late frame is worth less than the next one
in   graph/correction   Correction    Latest(1)   a versioned absolute state: the newest says it all
in   odometry/prior     OdometryPrior Latest(64)  0.3 s at 200 Hz, while a frame is tracked; older
                                                  poses are worth less, and no robot waits for us
in   detection/boxes    DetectionBoxes Latest(1)  who may walk away is not tracked against
out  pose/tracked       TrackedPose
out  keyframe/new       Keyframe      made only when every consumer has room: never waited for
"""

import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ldo_service.conversions.frames import camera_message, mask_message, rgbd_of
from ldo_service.conversions.poses import (
    keyframe_poses_of,
    matrix6_message,
    measured_message,
    pose_message,
    transform,
)
from ldo_service.detection.dynamic_classes import Box
from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.geometry.keyframe_poses import KeyframePoses, RelativePose
from ldo_service.runtime import Actor, In, Latest, Out
from ldo_service.schemas import (
    Array,
    Correction,
    Detection,
    DetectionBoxes,
    FrameRgbd,
    Keyframe,
    OdometryPrior,
    TrackedPose,
)
from ldo_service.schemas.message import decode, encode
from ldo_service.schemas.topics import (
    DETECTION_BOXES,
    FRAME_RGBD,
    GRAPH_CORRECTION,
    KEYFRAME_NEW,
    ODOMETRY_PRIOR,
    POSE_TRACKED,
)
from ldo_service.tracking.odometry import Odometry, OdometryConfig
from ldo_service.tracking.odometry_prior import Prior, Reading, Verdict
from ldo_service.tracking.relocalization import ReusedKeyframe
from ldo_service.tracking.tracking_quality import Status
from ldo_service.tracking.tracking_result import Tracked

log = logging.getLogger(__name__)

UNIT_WITHIN = 1e-3  # of a quaternion's norm: four digits, as people copy them, and then normalised
MANY_MISSED = 30  # frames in a row that no prior reaches: a second, no hiccup any more
VIEWS = "keyframe", "supporting"  # of the odometry's state, each a part of its own
RECENT_KEYFRAMES = 32  # four windows of keyframe/new: the optimizer cannot be further behind


@dataclass(frozen=True, slots=True)
class Mounting:
    """Where the camera sits on the robot: T_base_camera.

    `camera` has the optical axes of this project: x right, y down, z forward. For a base whose x
    is forward and z up (REP-103) a camera that looks ahead has quaternion 0.5 -0.5 0.5 -0.5.
    """

    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the camera's centre in base
    quaternion_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  # base is the camera

    def __post_init__(self) -> None:
        if not np.isfinite((*self.translation_m, *self.quaternion_wxyz)).all():
            raise ConfigError(f"tracker.T_base_camera holds NaN or infinity: {self}.")
        norm = float(np.linalg.norm(self.quaternion_wxyz))
        if abs(norm - 1.0) > UNIT_WITHIN:
            raise ConfigError(
                f"tracker.T_base_camera.quaternion_wxyz={list(self.quaternion_wxyz)} has norm "
                f"{norm:.4g}: a rotation has norm 1. The order is w x y z."
            )

    def matrix(self) -> np.ndarray:
        """T_base_camera [4, 4]."""
        return se3.from_quaternion(np.array(self.translation_m), np.array(self.quaternion_wxyz))


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    T_base_camera: Mounting = field(default_factory=Mounting)
    odometry: OdometryConfig = field(default_factory=OdometryConfig)
    localise: str = ""  # folder of a finished run: track in its map, which stays as it is
    hold_out: int = 0  # every n-th frame is tracked and never mapped, to judge the map by; 0: none

    def __post_init__(self) -> None:
        if self.hold_out < 0 or self.hold_out == 1:
            raise ConfigError(f"tracker.hold_out={self.hold_out}: must be 0, or 2 and more.")


class Tracker(Actor):
    """Odometry against the last keyframe; the map's frame hangs on the optimizer's poses."""

    name = "tracker"
    inputs = (
        In(FRAME_RGBD, Latest(1)),
        In(GRAPH_CORRECTION, Latest(1)),
        In(ODOMETRY_PRIOR, Latest(64)),
        In(DETECTION_BOXES, Latest(1)),
    )
    outputs = (Out(POSE_TRACKED), Out(KEYFRAME_NEW, never_wait=True))
    is_prompt = True

    def __init__(self, config: TrackerConfig | None = None) -> None:
        super().__init__()
        self.config = config or TrackerConfig()
        self._T_base_camera = self.config.T_base_camera.matrix()
        self._odometry = Odometry(self.config.odometry)
        self._poses = KeyframePoses()  # of the last keyframes and the one tracked against
        self._correction = b""  # the last, as a body: places all keyframes, old ones too
        self._joined: dict[int, int] = {}  # segments placed in an older one, as it says
        self._T_map: dict[int, np.ndarray] | None = None  # what it says, once that is asked for
        self._made = self._without_room = self._returns = 0
        self._prior = Prior()
        self._verdicts: Counter[Verdict] = Counter()  # on poses of the prior
        self._with_prior = self._without_prior = 0  # frames, since there is one
        self._missed = 0  # frames in a row that it does not reach
        self._parts: dict[str, Any] | None = None  # of the state; what a prior does not change

    def handle(
        self, message: FrameRgbd | Correction | OdometryPrior | DetectionBoxes
    ) -> Iterator[TrackedPose | Keyframe]:
        if isinstance(message, OdometryPrior):
            self._take_prior(message)
            return
        self._parts = None
        if isinstance(message, Correction):
            self._correct(message)
        elif isinstance(message, DetectionBoxes):
            self._odometry.leave_out(message.keyframe, [_box(d) for d in message.detections])
        else:
            yield from self._track(rgbd_of(message))

    def _track(self, frame: RgbdFrame) -> Iterator[TrackedPose | Keyframe]:
        tracked = self._odometry.track(frame, self._prior_of(frame))
        if tracked.method == "relocalised":
            self._recall(tracked)
        if tracked.may_begin and self._may_map(frame):
            tracked = self._odometry.begin_segment(frame)
        seen = self._seen_again(frame, tracked)
        if seen is not None and self._odometry.is_tied:
            tracked, seen = self._return_to(seen, tracked), None
        is_wanted = tracked.wants_mapping and tracked.status is Status.OK
        is_mapped = is_wanted and self._may_map(frame)
        keyframe = self._make_keyframe(frame, tracked, seen) if is_mapped else None
        if keyframe is not None:
            yield keyframe
        elif tracked.method == "first":
            return  # nobody is there to map it yet: begin with a later frame
        yield self._tracked_pose(frame, tracked, None if keyframe is None else keyframe.keyframe)

    # --- the other odometry -----------------------------------------------------------------------
    def _take_prior(self, message: OdometryPrior) -> None:
        T_odom_base = transform(message.T_odom_base)
        config = self.config.odometry.prior
        self._prior, verdict = self._prior.added(message.stamp_ns, T_odom_base, config)
        self._verdicts[verdict] += 1
        if verdict is not Verdict.FOLLOWS and self._verdicts[verdict] == 1:
            log.warning(
                "odometry/prior: the pose of stamp %d %s. Further such poses are only counted.",
                message.stamp_ns, verdict,
            )  # fmt: skip

    def _prior_of(self, frame: RgbdFrame) -> Reading | None:
        """Where the other odometry has a frame, if there is one."""
        if not self._prior.poses:
            return None
        reading = self._prior.at(frame.stamp_ns, self._T_base_camera, self.config.odometry.prior)
        self._with_prior += reading is not None
        self._without_prior += reading is None
        self._missed = self._missed + 1 if reading is None else 0
        if self._missed == MANY_MISSED:
            log.warning(
                "odometry/prior: %d frames were tracked without it, and its newest pose is %.3f s "
                "older than the last of them: does it still come, and do both stamp by one clock?",
                MANY_MISSED, 1e-9 * (frame.stamp_ns - self._prior.poses[-1].stamp_ns),
            )  # fmt: skip
        return reading

    # --- keyframes --------------------------------------------------------------------------------
    def _may_map(self, frame: RgbdFrame) -> bool:
        """Whether the frame may become a keyframe: it is not held out, and everyone has room."""
        hold_out = self.config.hold_out
        if hold_out and frame.index % hold_out == hold_out - 1:
            return False
        has_room = self.has_room(KEYFRAME_NEW)
        self._without_room += not has_room
        return has_room

    def _make_keyframe(
        self, frame: RgbdFrame, tracked: Tracked, seen: ReusedKeyframe | None
    ) -> Keyframe:
        """A new reference for tracking, or one that supports the map between two of these.

        seen  a known keyframe that the camera may go back to, once the graph knows of it
        """
        window: list[RelativePose] = []
        if seen is not None:
            keyframe = self._odometry.make_keyframe(frame, tracked, is_tied=True)
            others = self._odometry.window(tracked)
            window = [seen.measures(keyframe), *(m for m in others if m.a != seen.place.id)]
        elif tracked.wants_keyframe:
            keyframe = self._odometry.make_keyframe(frame, tracked)
            window = self._odometry.window(tracked)
        else:
            keyframe = self._odometry.make_supporting(frame, tracked)
        self._poses.chain(
            keyframe,
            tracked.keyframe,
            tracked.T_keyframe_camera,
            tracked.T_odom_camera,
            tracked.segment,
        )
        self._poses.keep_only(self._needed(keyframe, tracked.keyframe))
        self._made += 1
        return Keyframe(
            stamp_ns=frame.stamp_ns,
            keyframe=keyframe,
            frame=frame.index,
            camera=camera_message(frame.camera),
            color=Array.of(frame.color),
            depth_m=Array.of(frame.depth_m),
            reference=tracked.keyframe,
            T_reference_keyframe=pose_message(tracked.T_keyframe_camera),
            information=matrix6_message(tracked.information),
            T_odom_keyframe=pose_message(tracked.T_odom_camera),
            overlap=tracked.overlap,
            window=tuple(map(measured_message, window)),
            is_moving=mask_message(tracked.is_moving, frame.camera),
            segment=tracked.segment,
            joins=()
            if tracked.join is None
            else (measured_message(tracked.join.measures(keyframe)),),
        )

    def _seen_again(self, frame: RgbdFrame, tracked: Tracked) -> ReusedKeyframe | None:
        """A keyframe that the map has already, where the frame would be mapped otherwise."""
        is_wanted = tracked.wants_mapping and tracked.join is None and self._odometry.may_return
        if not is_wanted or tracked.keyframe is None or tracked.keyframe not in self._poses:
            return None
        T_map_camera = self._poses[tracked.keyframe] @ tracked.T_keyframe_camera
        return self._odometry.seen_again(frame, tracked, self._T_map_keyframe(), T_map_camera)

    def _return_to(self, seen: ReusedKeyframe, tracked: Tracked) -> Tracked:
        self._returns += 1
        returned = self._odometry.return_to(seen, tracked)
        self._place(seen.place.id, returned, self._T_map_keyframe()[seen.place.id])
        return returned

    def _needed(self, newest: int, reference: int | None) -> Iterator[int]:
        """Those tracked against, before and from now on, and those that the optimizer may not have
        placed yet."""
        tracked_against = (reference, self._odometry.keyframe)
        return (k for k in self._poses if k > newest - RECENT_KEYFRAMES or k in tracked_against)

    # --- poses ------------------------------------------------------------------------------------
    def _correct(self, message: Correction) -> None:
        if message.graph_version > self._poses.version:
            self._correction, self._joined = encode(message), dict(message.joined)
            self._T_map = None
        T_map = keyframe_poses_of(message, only=self._poses)
        self._poses.correct(message.graph_version, T_map)

    def _recall(self, tracked: Tracked) -> None:
        """Know where in the map the keyframe is that a lost frame was found by."""
        keyframe = tracked.keyframe
        if keyframe is None or keyframe in self._poses:
            return
        self._place(keyframe, tracked, self._T_map_keyframe().get(keyframe))

    def _place(self, keyframe: int, tracked: Tracked, T_map_keyframe: np.ndarray | None) -> None:
        """Know where a keyframe is that a frame was tracked against; None: by odometry."""
        T_odom_keyframe = tracked.T_odom_camera @ se3.inverse(tracked.T_keyframe_camera)
        newest = max(self._poses, default=keyframe)
        self._poses.chain(keyframe, None, np.eye(4), T_odom_keyframe, tracked.segment)
        if T_map_keyframe is not None:
            self._poses.place(keyframe, T_map_keyframe)
        self._poses.keep_only(self._needed(newest, keyframe))

    def _T_map_keyframe(self) -> dict[int, np.ndarray]:
        """[4, 4] by id, of all keyframes that the last correction places."""
        if self._T_map is None:
            correction = decode(self._correction, Correction) if self._correction else None
            self._T_map = {} if correction is None else keyframe_poses_of(correction)
        return self._T_map

    def _tracked_pose(
        self, frame: RgbdFrame, tracked: Tracked, keyframe: int | None
    ) -> TrackedPose:
        """The first keyframe refers to itself; before it nothing is known."""
        reference = keyframe if tracked.keyframe is None else tracked.keyframe
        T_map_odom = np.eye(4) if reference is None else self._poses.T_map_odom(reference)
        segment = self._placed_in(tracked.segment)
        return self._pose_message(frame, tracked, T_map_odom, reference, keyframe, segment)

    def _pose_message(
        self,
        frame: RgbdFrame,
        tracked: Tracked,
        T_map_odom: np.ndarray,
        reference: int | None,
        keyframe: int | None = None,
        segment: int = 0,
    ) -> TrackedPose:
        return TrackedPose(
            stamp_ns=frame.stamp_ns,
            frame=frame.index,
            status=tracked.status.value,
            T_odom_camera=pose_message(tracked.T_odom_camera),
            T_map_odom=pose_message(se3.orthonormalised(T_map_odom)),
            graph_version=self._poses.version,
            reference=reference,
            T_reference_camera=pose_message(tracked.T_keyframe_camera),
            keyframe=keyframe,
            covariance=matrix6_message(np.linalg.pinv(tracked.information, hermitian=True)),
            inlier_fraction=tracked.inlier_fraction,
            residual_color=tracked.intensity_sigma,
            residual_depth=tracked.depth_noise_scale,
            overlap=tracked.overlap,
            iterations=tracked.iterations,
            method=tracked.method,
            disagreement=tracked.disagreement_rad,
            T_base_camera=pose_message(self._T_base_camera),
            segment=segment,
        )

    def _placed_in(self, segment: int) -> int:
        """The oldest segment that it is joined to, as the optimizer knows."""
        return self._joined.get(segment, segment)

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """A part for each place, written once, and few for what changes."""
        if self._parts is None:
            self._parts = self._tracked_parts()
        return {**self._parts, "prior": self._prior.packed}

    def _tracked_parts(self) -> dict[str, Any]:
        """All that does not change with each pose of a prior."""
        state = self._odometry.state()
        places = {place["id"]: place for place in state.pop("places")}
        state["order"] = [*places]  # as they were come by last
        views = {name: state.pop(name) for name in VIEWS}
        localise = self.config.localise
        now = {"odometry": state, "poses": self._poses.snapshot(), "localise": localise}
        parts = {f"place_{number}": place for number, place in places.items()}
        return {**parts, **views, "correction": self._correction, "now": now}

    def restore(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        now = state["now"]
        if now["localise"] != self.config.localise:
            raise ConfigError(
                f"the saved state is of --localise {now['localise'] or '(none)'}, this service of "
                f"{self.config.localise or '(none)'}. Choose another folder with --state."
            )
        places = [state[f"place_{number}"] for number in now["odometry"]["order"]]
        views = {name: state[name] for name in VIEWS}
        self._odometry.restore({**now["odometry"], **views, "places": places})
        self._prior, self._parts = Prior.unpacked(state["prior"]), None
        self._poses.restore(now["poses"])
        self._correction, self._T_map = state["correction"], None
        if self._correction:
            self._joined = dict(decode(self._correction, Correction).joined)

    def facts(self) -> dict[str, float]:
        refused = self._verdicts[Verdict.LATE] + self._verdicts[Verdict.BROKEN]
        restarts = self._verdicts[Verdict.RESTARTED] + self._verdicts[Verdict.JUMPED]
        return {
            "keyframes": self._made,
            "keyframes_without_room": self._without_room,
            "keyframes_returned_to": self._returns,
            "frames_with_prior": self._with_prior,
            "frames_without_prior": self._without_prior,  # since the first pose of it
            "prior_refused": refused,
            "prior_restarts": restarts,
        }


def _box(detection: Detection) -> Box:
    """From pixel centres at integers to edges of pixels."""
    x0, y0, x1, y1 = (edge + 0.5 for edge in detection.box_px)
    return Box(detection.label, x0, y0, x1, y1)
