"""Messages between the actors and to other programs.

A message is a frozen msgspec struct. It is sent as a MessagePack map, which any MessagePack library
can read. The map has an entry for each field of the struct, and the entry `type` with the name of
the struct. New fields are added at the end and have a default. The meaning of a field never
changes. `ldo_service.geometry` describes the frames and units. The package imports msgspec and
numpy only.
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
from ldo_service.schemas.graph import GraphCorrection, GraphLandmark
from ldo_service.schemas.health import Health, InputCount, OutputCount
from ldo_service.schemas.keyframe import (
    CameraCorrection,
    Keyframe,
    KeyframeMeasurements,
    KeyframeRefinement,
    MeasuredPose,
)
from ldo_service.schemas.labels import AddLabel, LabelNames, LabelRequest, LabelResult
from ldo_service.schemas.loops import LoopCandidate, LoopClosure
from ldo_service.schemas.map import (
    AnchorMotion,
    Gaussians,
    MapDelta,
    MapRendering,
    MapSnapshot,
    RefineMap,
)
from ldo_service.schemas.message import Message, decode, encode
from ldo_service.schemas.objects import MapObject, MapObjects, ObjectObservation, ObjectView
from ldo_service.schemas.odometry import OdometryPrior
from ldo_service.schemas.pose import Pose, TrackedPose, TrackingStatus

__all__ = [
    "AddLabel",
    "AnchorMotion",
    "Array",
    "CameraColor",
    "CameraCorrection",
    "CameraDepth",
    "CameraModel",
    "CameraRgbd",
    "ControlAnswer",
    "ControlRequest",
    "Detection",
    "DetectionBoxes",
    "FrameRgbd",
    "Gaussians",
    "GraphCorrection",
    "GraphLandmark",
    "Health",
    "Image",
    "InputCount",
    "Keyframe",
    "KeyframeMeasurements",
    "KeyframeRefinement",
    "LabelNames",
    "LabelRequest",
    "LabelResult",
    "LoopCandidate",
    "LoopClosure",
    "MapDelta",
    "MapObject",
    "MapObjects",
    "MapRendering",
    "MapSnapshot",
    "MeasuredPose",
    "Message",
    "ObjectObservation",
    "ObjectView",
    "OdometryPrior",
    "OutputCount",
    "Pose",
    "RefineMap",
    "TrackedPose",
    "TrackingStatus",
    "decode",
    "encode",
]
