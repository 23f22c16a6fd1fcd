"""Map of Gaussians: renderings, changes and snapshots.

A map replica is a copy of the map in another process. These steps keep the arrays of a replica
equal to those of the mapper:

1. Receive all parts of a snapshot of version v.
2. Apply every delta with `base_version >= v`, in order. Of each delta, apply first `motions`, then
   `removed`, then `changed`; append `added` at the end. The replica then has the delta's `version`.
3. If the `base_version` of a delta is not the version of the replica, a delta was missed. Start
   again with a snapshot.
"""

import msgspec
import numpy as np

from ldo_service.schemas.array import Array
from ldo_service.schemas.detections import MAX_LABEL_LENGTH
from ldo_service.schemas.frames import CameraModel
from ldo_service.schemas.message import Message, require_count, require_finite
from ldo_service.schemas.pose import Pose

NO_LABELS = Array.of(np.zeros((0, 32), np.uint8))


class Gaussians(msgspec.Struct, frozen=True, kw_only=True):
    """Batch of N Gaussians.

    A row of `params` holds: mean xyz (map frame, meters), log of the scales (meters), quaternion
    wxyz, logit of the opacity, RGB 0..1, two unused numbers.

    A row of `labels` holds the observed labels of a Gaussian, little-endian:

    bytes  0..19  five weights of labels (f4), the largest first
    bytes 20..23  sum of the weights of all observations; the weights of older ones decay (f4)
    bytes 24..25  size of the object in mm at the last observation of a label, see below (u2)
    byte  26      number of keyframes since then that show the Gaussian in no object (u1)
    bytes 27..31  labels of the five weights, indices into `label_names` (u1)

    The five weights of labels are probabilities, whose sum is at most 1. The difference from 1 is
    the weight of background, which is label 0. The likeliest label is the value of byte 27 if the
    first weight is larger than that of background. Otherwise, the likeliest label is 0. The size of
    an object is the side, at the depth of the Gaussian, of a square with the area of the object's
    2D box.
    """

    ids: Array  # Ids, i8 [N], unique, ascending.
    params: Array  # Parameters, f4 [N, 16].
    anchors: Array  # Anchor keyframe of each Gaussian, i4 [N].
    labels: Array = NO_LABELS  # Labels, u1 [N, 32]; [0, 32] if all are zero: no label was observed.

    def __post_init__(self) -> None:
        self.ids.require("ids", "i8", (None,))
        self.ids.require_ascending("ids")
        count = self.ids.shape[0]
        self.params.require("params", "f4", (count, 16))
        self.params.require_finite("params")
        self.anchors.require("anchors", "i4", (count,))
        self.labels.require("labels", "u1", (count if self.labels.shape[0] else 0, 32))
        require_weights(self.labels)


class AnchorMotion(msgspec.Struct, frozen=True, kw_only=True):
    """Rigid motion of the means and rotations of all Gaussians whose anchor is `keyframe`."""

    keyframe: int
    T_new_old: Pose  # Transform in the map frame: mean_new = T_new_old mean_old.

    def __post_init__(self) -> None:
        require_count("keyframe", self.keyframe)


class MapDelta(Message, frozen=True, kw_only=True):
    """Changes of the map from version `base_version` to `version`, published on map/delta."""

    base_version: int
    version: int
    graph_version: int  # Version of the keyframe poses that the means refer to.
    motions: tuple[AnchorMotion, ...]
    removed: Array  # Ids of removed Gaussians, i8 [R], ascending.
    changed: Gaussians
    added: Gaussians
    # Names of all labels by index if this delta adds labels, else empty; indices never change.
    label_names: tuple[str, ...] = ()

    def check(self) -> None:
        require_version(self.version, self.graph_version)
        require_names(self.label_names)
        self.removed.require("removed", "i8", (None,))
        self.removed.require_ascending("removed")
        if not 0 <= self.base_version < self.version:
            raise ValueError(
                f"version {self.version} of a delta must be larger than its base_version "
                f"{self.base_version}"
            )


NO_KEYFRAMES = Array.of(np.zeros(0, np.int64))
NO_EXPOSURES = Array.of(np.zeros((0, 2, 3), np.float32))


class MapSnapshot(Message, frozen=True, kw_only=True):
    """One of several messages that together contain the whole map at `version`.

    The messages are published on map/snapshot and numbered by `part`, from 0 to `parts` - 1. Part 0
    also has the exposure of each keyframe and the names of the labels. The exposure is a gain and a
    bias per channel. A color of the map, in 0..1, appears in the image of a keyframe as
    gain * color + bias.
    """

    version: int
    graph_version: int
    part: int
    parts: int
    gaussians: Gaussians
    keyframes: Array = NO_KEYFRAMES  # Keyframe ids, i8 [K], ascending.
    exposures: Array = NO_EXPOSURES  # Gains, then biases of the RGB channels, f4 [K, 2, 3].
    label_names: tuple[str, ...] = ()  # Names of all labels by index; empty without detections.

    def check(self) -> None:
        require_version(self.version, self.graph_version)
        require_names(self.label_names)
        self.keyframes.require("keyframes", "i8", (None,))
        self.keyframes.require_ascending("keyframes")
        self.exposures.require("exposures", "f4", (self.keyframes.shape[0], 2, 3))
        self.exposures.require_finite("exposures")
        if not 0 <= self.part < self.parts:
            raise ValueError(
                f"part is {self.part} and parts is {self.parts}, must be 0 <= part < parts"
            )


class MapRendering(Message, frozen=True, kw_only=True):
    """Rendering of the map at the pose of `keyframe`, published on map/view."""

    keyframe: int
    version: int  # Version of the map.
    graph_version: int
    camera: CameraModel
    T_map_camera: Pose
    color: Array  # RGB on black, u1 [H, W, 3].
    # Depth in meters at which half the light is absorbed, f4 [H, W]; 0 where the map is empty.
    depth_m: Array
    opacity: Array  # Opacity, u1 [H, W]; 255 is opaque.

    def check(self) -> None:
        require_count("keyframe", self.keyframe)
        require_version(self.version, self.graph_version)
        size = (self.camera.height, self.camera.width)
        self.color.require("color", "u1", (*size, 3))
        self.depth_m.require("depth_m", "f4", size)
        self.depth_m.require_finite("depth_m")
        self.opacity.require("opacity", "u1", size)


MAX_ITERATIONS = 500  # They take about half a minute, in which no keyframe is mapped.


class RefineMap(Message, frozen=True, kw_only=True):
    """Request to the mapper to optimize all Gaussians further, published on map/refine.

    The mapper runs the given number of iterations on the images of its keyframes.
    """

    iterations: int
    initial_rate: float = 1.0  # Factor on the length of the first step, in (0, 1].
    # Factor on the length of the last step; factors between are interpolated geometrically.
    final_rate: float = 1.0

    def check(self) -> None:
        require_count("iterations", self.iterations)
        if self.iterations > MAX_ITERATIONS:
            raise ValueError(
                f"iterations is {self.iterations}, must be at most {MAX_ITERATIONS} per request"
            )
        require_finite("rates", (self.initial_rate, self.final_rate))
        if not (0 < self.initial_rate <= 1 and 0 < self.final_rate <= 1):
            raise ValueError(
                f"initial_rate {self.initial_rate} and final_rate {self.final_rate} must be in "
                "(0, 1]"
            )


MAX_NAMES = 256  # Number of values of one byte.


def require_names(names: tuple[str, ...]) -> None:
    """Raise ValueError if there are too many label names or a name is too long."""
    if len(names) > MAX_NAMES:
        raise ValueError(f"{len(names)} label_names are too many, at most {MAX_NAMES} are allowed")
    longest = max(map(len, names), default=0)
    if longest > MAX_LABEL_LENGTH:
        raise ValueError(
            f"a name in label_names has {longest} characters, must have at most {MAX_LABEL_LENGTH}"
        )


def require_weights(labels: Array) -> None:
    """Raise ValueError if a weight of `labels` (bytes 0..23 of a row) is negative or not finite."""
    numbers = np.ascontiguousarray(labels.numpy()[:, :24]).view("<f4")
    if not (np.isfinite(numbers).all() and (numbers >= 0).all()):
        raise ValueError(
            "labels hold negative, NaN or infinite weights: the six numbers in bytes 0..23 of each "
            "row must be finite and at least 0"
        )


def require_version(version: int, graph_version: int) -> None:
    """Raise ValueError unless both versions are at least 0 and fit in an int64."""
    require_count("version", version)
    require_count("graph_version", graph_version)
