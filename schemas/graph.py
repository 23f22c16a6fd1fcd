"""Output of the pose-graph optimizer: keyframe poses and landmarks in the map frame."""

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

Pair = tuple[int, int]  # Ids of two keyframes, or numbers of two submaps.


class GraphLandmark(msgspec.Struct, frozen=True, kw_only=True):
    """Landmark of an object: its fused position and class distribution."""

    object: int  # Id of the object, as in map/objects.
    centroid: Vector3  # Map frame, meters.
    distribution: Distribution  # Fused over the observations of all keyframes.
    entropy: float  # Entropy over all classes, nats; `distribution` lists only the likeliest ones.

    def __post_init__(self) -> None:
        require_count("object", self.object)
        require_finite("centroid", self.centroid)
        require_distribution(self.distribution)
        require_entropy(self.entropy)


class GraphCorrection(Message, frozen=True, kw_only=True):
    """Poses of all keyframes in the map frame, published on graph/correction.

    The poses are not relative to earlier messages. The newest message therefore replaces all
    earlier messages of graph/correction. The poses take 56 bytes per keyframe.
    """

    graph_version: int  # Version of the poses, ascending.
    keyframes: Array  # Keyframe ids, i8 [K], ascending.
    T_map_keyframe: Array  # Translation in meters and quaternion wxyz, f8 [K, 7].
    last_refinement: int = 0  # Number of the last keyframe/refinement that the poses include.
    # Numbers of each merged submap, and of the oldest submap that it is merged with.
    merged_submaps: tuple[Pair, ...] = ()
    # Accepted loop closures: ids of the old keyframe (`reference`) and of the new one.
    accepted_closures: tuple[Pair, ...] = ()
    # Loop closures that were rejected or removed, as in `accepted_closures`; the newest 512.
    rejected_closures: tuple[Pair, ...] = ()
    landmarks: tuple[GraphLandmark, ...] = ()  # Ascending by object id.

    def check(self) -> None:
        require_count("graph_version", self.graph_version)
        require_count("last_refinement", self.last_refinement)
        if any(not 0 <= older < submap for submap, older in self.merged_submaps):
            raise ValueError(
                f"merged_submaps is {self.merged_submaps}; each pair must hold the numbers of a "
                "merged and an older submap, and the older submap must have the smaller number"
            )
        self.keyframes.require("keyframes", "i8", (None,))
        count = self.keyframes.shape[0]
        self.T_map_keyframe.require("T_map_keyframe", "f8", (count, 7))
        self.T_map_keyframe.require_finite("T_map_keyframe")
        self.keyframes.require_ascending("keyframes")
        quaternions = self.T_map_keyframe.numpy()[:, 3:]
        with np.errstate(over="ignore"):  # Overflow gives infinity, which fails below.
            norms = np.sqrt((quaternions**2).sum(axis=1))
        if (abs(norms - 1.0) > QUATERNION_TOLERANCE).any():
            raise ValueError(
                "T_map_keyframe holds a quaternion without unit norm; each norm must be 1 within "
                f"{QUATERNION_TOLERANCE}"
            )
