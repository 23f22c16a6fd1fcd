"""What travels between the actors and to other programs. Imports msgspec and numpy only.

A message is one frozen, tagged struct; its body is MessagePack, a map with the struct's field
names and `type`, so any MessagePack library reads it. Fields are added at the end and with a
default; what a field means never changes. Conventions of frames and units are those of
`ldo_service.geometry`.
"""

from ldo_service.schemas.array import Array
from ldo_service.schemas.control import ControlAnswer, ControlRequest
from ldo_service.schemas.detections import Detection, DetectionBoxes
from ldo_service.schemas.frames import (
    CameraColor,
    CameraDepth,
    CameraModel,
    CameraRgbd,
    FrameRgbd,
    Image,
)
from ldo_service.schemas.graph import Correction, GraphLandmark
from ldo_service.schemas.health import Health, InputCount, OutputCount
from ldo_service.schemas.keyframe import Keyframe, KeyframeRefinement, MeasuredPose
from ldo_service.schemas.labels import LabelAdd, LabelNames, LabelOpen, LabelRequest
from ldo_service.schemas.loops import LoopCandidate, LoopClosure
from ldo_service.schemas.map import (
    AnchorMotion,
    Gaussians,
    MapDelta,
    MapRefine,
    MapSnapshot,
    ModelView,
)
from ldo_service.schemas.message import Message, decode, encode
from ldo_service.schemas.objects import MapObject, MapObjects, ObjectObservation, ObjectView
from ldo_service.schemas.odometry import OdometryPrior
from ldo_service.schemas.pose import Pose, TrackedPose, TrackingStatus

__all__ = [
    "AnchorMotion",
    "Array",
    "CameraColor",
    "CameraDepth",
    "CameraModel",
    "CameraRgbd",
    "ControlAnswer",
    "ControlRequest",
    "Correction",
    "Detection",
    "DetectionBoxes",
    "FrameRgbd",
    "Gaussians",
    "GraphLandmark",
    "Health",
    "Image",
    "InputCount",
    "Keyframe",
    "KeyframeRefinement",
    "LabelAdd",
    "LabelNames",
    "LabelOpen",
    "LabelRequest",
    "LoopCandidate",
    "LoopClosure",
    "MapDelta",
    "MapObject",
    "MapObjects",
    "MapRefine",
    "MapSnapshot",
    "MeasuredPose",
    "Message",
    "ModelView",
    "ObjectObservation",
    "ObjectView",
    "OdometryPrior",
    "OutputCount",
    "Pose",
    "TrackedPose",
    "TrackingStatus",
    "decode",
    "encode",
]
