"""Topics on the network; the Zenoh key of a topic is `ldo/<robot>/<name>`.

Each topic has one producer. On a state topic, the producer also answers a query with the last value
of the topic, for subscribers that start later.
"""

from dataclasses import dataclass

from ldo_service.schemas.control import ControlAnswer, ControlRequest
from ldo_service.schemas.detections import DetectionBoxes
from ldo_service.schemas.frames import CameraColor, CameraDepth, CameraRgbd, FrameRgbd
from ldo_service.schemas.graph import GraphCorrection
from ldo_service.schemas.health import Health
from ldo_service.schemas.keyframe import Keyframe, KeyframeMeasurements, KeyframeRefinement
from ldo_service.schemas.labels import AddLabel, LabelNames, LabelRequest, LabelResult
from ldo_service.schemas.loops import LoopCandidate, LoopClosure
from ldo_service.schemas.map import MapDelta, MapRendering, MapSnapshot, RefineMap
from ldo_service.schemas.message import Message
from ldo_service.schemas.objects import MapObjects, ObjectObservation
from ldo_service.schemas.odometry import OdometryPrior
from ldo_service.schemas.pose import TrackedPose

ROBOT_PREFIX = "ldo"
# Maximum size of a message without images that other programs publish, bytes. The largest one, a
# name with spaces around it, has some hundred bytes.
SMALL_MESSAGE_BYTES = 65_536


@dataclass(frozen=True, slots=True)
class Topic:
    """Topic with its name, message type and description."""

    name: str
    message: type[Message]
    description: str
    is_state: bool = False  # True if the topic also answers queries with its last value.
    # Name of a field of the message, or None. Inputs with the policy `Latest(per_key=True)` keep
    # the latest message per value of this field.
    key: str | None = None
    answer: type[Message] | None = None  # Type of the reply if `message` is the payload of a query.
    is_per_actor: bool = False  # True if each actor publishes on its own key, `<name>/<actor>`.
    # Maximum size of a message, bytes; None: only the limit of all messages applies.
    max_bytes: int | None = None

    @property
    def subscription_key(self) -> str:
        """Key expression, without `ldo/<robot>/`, that matches all messages of the topic."""
        return f"{self.name}/*" if self.is_per_actor else self.name

    def expression(self, robot: str) -> str:
        """Return the Zenoh key expression of the topic."""
        return f"{ROBOT_PREFIX}/{robot}/{self.name}"


CAMERA_RGBD = Topic("camera/rgbd", CameraRgbd, "RGB-D frame of the camera")
CAMERA_COLOR = Topic("camera/color", CameraColor, "color image of a camera with two topics")
CAMERA_DEPTH = Topic("camera/depth", CameraDepth, "depth image, paired with color by stamp")
ODOMETRY_PRIOR = Topic(
    "odometry/prior",
    OdometryPrior,
    "pose of the robot's base from another odometry",
    max_bytes=SMALL_MESSAGE_BYTES,
)
FRAME_RGBD = Topic("frame/rgbd", FrameRgbd, "rectified frame, depth in meters")
POSE_TRACKED = Topic("pose/tracked", TrackedPose, "camera pose of each frame", is_state=True)
KEYFRAME_NEW = Topic("keyframe/new", Keyframe, "frame to be mapped, with its relative pose")
KEYFRAME_MEASUREMENTS = Topic(
    "keyframe/measurements", KeyframeMeasurements, "relative poses of each keyframe, no images"
)
KEYFRAME_REFINEMENT = Topic(
    "keyframe/refinement", KeyframeRefinement, "refined relative poses of keyframes"
)
DETECTION_BOXES = Topic(
    "detection/boxes", DetectionBoxes, "boxes with class and score for each keyframe"
)
LABEL_REQUEST = Topic(
    "label/request", LabelRequest, "image crops of a region that needs a label", key="region"
)
LABEL_RESULT = Topic("label/result", LabelResult, "label of a requested region", key="region")
LABEL_ADD = Topic(
    "label/add",
    AddLabel,
    "request to add a name to the labeller's list",
    max_bytes=SMALL_MESSAGE_BYTES,
)
LABEL_NAMES = Topic(
    "label/names", LabelNames, "names that the labeller chooses from", is_state=True
)
MAP_VIEW = Topic("map/view", MapRendering, "map rendered at the newest keyframe")
MAP_DELTA = Topic("map/delta", MapDelta, "changes of the map since the last version")
MAP_SNAPSHOT = Topic("map/snapshot", MapSnapshot, "whole map, in parts", is_state=True)
MAP_REFINE = Topic(
    "map/refine",
    RefineMap,
    "request for more iterations on the map",
    max_bytes=SMALL_MESSAGE_BYTES,
)
GRAPH_CORRECTION = Topic("graph/correction", GraphCorrection, "all keyframe poses", is_state=True)
HEALTH = Topic(
    "health", Health, "counters and latency of an actor (health/<actor>)", is_per_actor=True
)
CONTROL = Topic(
    "control", ControlRequest, "request to pause, resume, save or reset", answer=ControlAnswer
)

MAP_OBJECTS = Topic("map/objects", MapObjects, "labelled objects of the map", is_state=True)
OBJECT_OBSERVATION = Topic(
    "object/observation", ObjectObservation, "observation or miss of an object in a keyframe"
)
LOOP_CLOSURE = Topic("loop/closure", LoopClosure, "verified pose between two distant keyframes")
LOOP_CANDIDATE = Topic(
    "loop/candidate", LoopCandidate, "every loop candidate, with its rejection reason"
)

TOPICS: tuple[Topic, ...] = (
    CAMERA_RGBD,
    CAMERA_COLOR,
    CAMERA_DEPTH,
    ODOMETRY_PRIOR,
    FRAME_RGBD,
    POSE_TRACKED,
    KEYFRAME_NEW,
    KEYFRAME_MEASUREMENTS,
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

FROM_OUTSIDE = (CAMERA_RGBD, CAMERA_COLOR, CAMERA_DEPTH)  # Published by camera programs.
# Published by wheel odometry, an inertial unit or another camera.
FROM_ODOMETRY = (ODOMETRY_PRIOR,)
FROM_OPERATORS = (MAP_REFINE, LABEL_ADD)
