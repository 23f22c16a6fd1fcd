"""Every topic, written once: `ldo/<robot>/<name>` on the network.

One producer each. A state topic also answers a query with its last value, for late joiners. A
topic without a message type is declared, and has neither producer nor format yet.
"""

from dataclasses import dataclass

from ldo_service.schemas.control import ControlAnswer, ControlRequest
from ldo_service.schemas.detections import DetectionBoxes
from ldo_service.schemas.frames import CameraColor, CameraDepth, CameraRgbd, FrameRgbd
from ldo_service.schemas.graph import GraphCorrection
from ldo_service.schemas.health import Health
from ldo_service.schemas.keyframe import Keyframe, KeyframeRefinement
from ldo_service.schemas.labels import AddLabel, LabelNames, LabelRequest, LabelResult
from ldo_service.schemas.loops import LoopCandidate, LoopClosure
from ldo_service.schemas.map import MapDelta, MapRendering, MapSnapshot, RefineMap
from ldo_service.schemas.message import Message
from ldo_service.schemas.objects import MapObjects, ObjectObservation
from ldo_service.schemas.odometry import OdometryPrior
from ldo_service.schemas.pose import TrackedPose

ROBOT_PREFIX = "ldo"


@dataclass(frozen=True, slots=True)
class Topic:
    name: str
    message: type[Message]
    description: str
    is_state: bool = False
    key: str | None = None  # field by which `Latest(per_key=True)` tells messages apart
    answer: type[Message] | None = None  # where `message` is what a query asks
    is_per_actor: bool = False  # each says it on a name of its own below this one

    @property
    def subscription_key(self) -> str:
        """The name of all that is said on it."""
        return f"{self.name}/*" if self.is_per_actor else self.name

    def expression(self, robot: str) -> str:
        """The Zenoh key expression."""
        return f"{ROBOT_PREFIX}/{robot}/{self.name}"


CAMERA_RGBD = Topic("camera/rgbd", CameraRgbd, "one exposure, as the camera sends it")
CAMERA_COLOR = Topic("camera/color", CameraColor, "its colour half, where colour comes apart")
CAMERA_DEPTH = Topic("camera/depth", CameraDepth, "its depth half; paired with colour by stamp")
ODOMETRY_PRIOR = Topic(
    "odometry/prior", OdometryPrior, "where another odometry has the robot's base"
)
FRAME_RGBD = Topic("frame/rgbd", FrameRgbd, "the frame, rectified, depth in metres")
POSE_TRACKED = Topic("pose/tracked", TrackedPose, "where the camera is", is_state=True)
KEYFRAME_NEW = Topic("keyframe/new", Keyframe, "a frame that the map is made from")
KEYFRAME_REFINEMENT = Topic(
    "keyframe/refinement", KeyframeRefinement, "better poses between keyframes"
)
DETECTION_BOXES = Topic(
    "detection/boxes", DetectionBoxes, "boxes with class and score, per keyframe"
)
LABEL_REQUEST = Topic(
    "label/request", LabelRequest, "image crops of a region to be named", key="region"
)
LABEL_RESULT = Topic(
    "label/result", LabelResult, "the name of a region, late by design", key="region"
)
LABEL_ADD = Topic("label/add", AddLabel, "asked: choose from this name too")
LABEL_NAMES = Topic("label/names", LabelNames, "what the labeller chooses from", is_state=True)
MAP_VIEW = Topic("map/view", MapRendering, "the map rendered at the newest keyframe")
MAP_DELTA = Topic("map/delta", MapDelta, "what changed in the map since the last version")
MAP_SNAPSHOT = Topic("map/snapshot", MapSnapshot, "the whole map, in parts", is_state=True)
MAP_REFINE = Topic("map/refine", RefineMap, "asked: so many iterations more")
GRAPH_CORRECTION = Topic("graph/correction", GraphCorrection, "all keyframe poses", is_state=True)
HEALTH = Topic(
    "health", Health, "counters and latency of an actor (health/<actor>)", is_per_actor=True
)
CONTROL = Topic(
    "control", ControlRequest, "asked: pause, resume, save or reset", answer=ControlAnswer
)

MAP_OBJECTS = Topic("map/objects", MapObjects, "the named objects", is_state=True)
OBJECT_OBSERVATION = Topic(
    "object/observation", ObjectObservation, "an object seen from a keyframe"
)
LOOP_CLOSURE = Topic("loop/closure", LoopClosure, "a verified pose between two distant keyframes")
LOOP_CANDIDATE = Topic("loop/candidate", LoopCandidate, "every candidate, and why it was refused")

TOPICS: tuple[Topic, ...] = (
    CAMERA_RGBD,
    CAMERA_COLOR,
    CAMERA_DEPTH,
    ODOMETRY_PRIOR,
    FRAME_RGBD,
    POSE_TRACKED,
    KEYFRAME_NEW,
    DETECTION_BOXES,
    LABEL_REQUEST,
    LABEL_RESULT,
    LABEL_ADD,
    LABEL_NAMES,
    MAP_VIEW,
    MAP_DELTA,
    MAP_SNAPSHOT,
    MAP_REFINE,
    MAP_OBJECTS,
    OBJECT_OBSERVATION,
    KEYFRAME_REFINEMENT,
    LOOP_CLOSURE,
    LOOP_CANDIDATE,
    GRAPH_CORRECTION,
    HEALTH,
    CONTROL,
)

BY_NAME = {topic.name: topic for topic in TOPICS}

FROM_OUTSIDE = (CAMERA_RGBD, CAMERA_COLOR, CAMERA_DEPTH)  # made by camera programs
FROM_ODOMETRY = (ODOMETRY_PRIOR,)  # made by the robot's wheels, inertial unit or other camera
FROM_OPERATORS = (MAP_REFINE, LABEL_ADD)
