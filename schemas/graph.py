"""What the optimizer says: where the keyframes and landmarks are in the map."""

import msgspec
import numpy as np

from ldo_service.schemas.array import Array
from ldo_service.schemas.message import Message, require_count, require_finite
from ldo_service.schemas.objects import (
    Distribution,
    Vector3,
    require_distribution,
    require_entropy,
)
from ldo_service.schemas.pose import QUATERNION_TOLERANCE

Pair = tuple[int, int]


class GraphLandmark(msgspec.Struct, frozen=True, kw_only=True):
    """An object as the observations of all keyframes together place and name it."""

    object: int  # id, as in map/objects
    centroid: Vector3  # map frame, metres
    distribution: Distribution
    entropy: float  # of it, nats, before it was cut to its heaviest classes

    def __post_init__(self) -> None:
        require_count("object", self.object)
        require_finite("centroid", self.centroid)
        require_distribution(self.distribution)
        require_entropy(self.entropy)


class GraphCorrection(Message, frozen=True, kw_only=True):
    """graph/correction: absolute, so the newest one says it all. 56 bytes a keyframe."""

    graph_version: int  # ascending
    keyframes: Array  # i8 [K], ids, ascending
    T_map_keyframe: Array  # f8 [K, 7]: translation in metres, quaternion wxyz
    last_refinement: int = 0  # number of the last keyframe/refinement that it takes into account
    merged_submaps: tuple[Pair, ...] = ()  # submaps, each with the older one it is placed in
    # Loop closures that it agrees with: reference and keyframe.
    accepted_closures: tuple[Pair, ...] = ()
    # Loop closures that were rejected or removed, the newest 512.
    rejected_closures: tuple[Pair, ...] = ()
    landmarks: tuple[GraphLandmark, ...] = ()  # by id

    def check(self) -> None:
        require_count("graph_version", self.graph_version)
        require_count("last_refinement", self.last_refinement)
        if any(not 0 <= older < submap for submap, older in self.merged_submaps):
            raise ValueError(f"merged_submaps={self.merged_submaps}: a submap joins an older one")
        self.keyframes.require("keyframes", "i8", (None,))
        count = self.keyframes.shape[0]
        self.T_map_keyframe.require("T_map_keyframe", "f8", (count, 7))
        self.T_map_keyframe.require_finite("T_map_keyframe")
        self.keyframes.require_ascending("keyframes")
        quaternions = self.T_map_keyframe.numpy()[:, 3:]
        with np.errstate(over="ignore"):  # an absurd number is as wrong as any other
            norms = np.sqrt((quaternions**2).sum(axis=1))
        if (abs(norms - 1.0) > QUATERNION_TOLERANCE).any():
            raise ValueError("T_map_keyframe holds a quaternion that is not of unit norm")
