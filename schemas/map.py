"""The map of Gaussians: what it looks like, what changed in it, and the whole of it.

A follower keeps arrays equal to the mapper's like this: take a snapshot of version v (all its
parts), then apply every delta with `base_version >= v` in order: first `motions`, then `removed`,
then `changed`, then `added` at the end. A delta whose `base_version` is not the version held means
one was missed: take a snapshot again.
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
    """N Gaussians. A row of `params` is

    mean xyz (map, metres), log of the scales (metres), quaternion wxyz, logit of the opacity,
    RGB 0..1, two unused numbers.

    A row of `labels` is what the Gaussian has been seen as, little-endian: bytes 0..19 five weights
    (f4), heaviest first; 20..23 how much was seen (f4); 24..25 side of the object in mm (u2); 26
    misses; 27..31 the labels that the weights belong to, indices into `label_names`. What the
    weights lack of one is background, label 0: the likeliest label is byte 27 where the first
    weight is more than that, else 0.
    """

    ids: Array  # i8 [N], unique, ascending
    params: Array  # f4 [N, 16]
    anchors: Array  # i4 [N], the keyframe that moves it
    labels: Array = NO_LABELS  # u1 [N, 32]; [0, 32]: nobody has seen any of them, all zero

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
    """Every Gaussian anchored at `keyframe` moved by T_new_old: mean and rotation."""

    keyframe: int
    T_new_old: Pose

    def __post_init__(self) -> None:
        require_count("keyframe", self.keyframe)


class MapDelta(Message, frozen=True, kw_only=True):
    """map/delta: how version `base_version` becomes version `version`."""

    base_version: int
    version: int
    graph_version: int  # of the keyframe poses that the means are expressed through
    motions: tuple[AnchorMotion, ...]
    removed: Array  # i8 [R], ids, ascending
    changed: Gaussians
    added: Gaussians
    label_names: tuple[str, ...] = ()  # by index, when there are new ones; indices never change

    def check(self) -> None:
        require_version(self.version, self.graph_version)
        require_names(self.label_names)
        self.removed.require("removed", "i8", (None,))
        self.removed.require_ascending("removed")
        if not 0 <= self.base_version < self.version:
            raise ValueError(f"delta from version {self.base_version} to {self.version} goes back")


NO_KEYFRAMES = Array.of(np.zeros(0, np.int64))
NO_EXPOSURES = Array.of(np.zeros((0, 2, 3), np.float32))


class MapSnapshot(Message, frozen=True, kw_only=True):
    """map/snapshot: one part of the whole map at `version`; parts 0 .. parts-1 make it complete.

    Part 0 names the exposure of each keyframe: its camera saw gain * color + bias, per channel, of
    the map's colours in 0..1. It also has the names of the labels.
    """

    version: int
    graph_version: int
    part: int
    parts: int
    gaussians: Gaussians
    keyframes: Array = NO_KEYFRAMES  # i8 [K], ids, ascending
    exposures: Array = NO_EXPOSURES  # f4 [K, 2, 3], gains, then biases
    label_names: tuple[str, ...] = ()  # by index; none where nobody looked for objects

    def check(self) -> None:
        require_version(self.version, self.graph_version)
        require_names(self.label_names)
        self.keyframes.require("keyframes", "i8", (None,))
        self.keyframes.require_ascending("keyframes")
        self.exposures.require("exposures", "f4", (self.keyframes.shape[0], 2, 3))
        self.exposures.require_finite("exposures")
        if not 0 <= self.part < self.parts:
            raise ValueError(f"part {self.part} of {self.parts} does not exist")


class MapRendering(Message, frozen=True, kw_only=True):
    """map/view: the map as rendered at the pose of `keyframe`."""

    keyframe: int
    version: int  # of the map
    graph_version: int
    camera: CameraModel
    T_map_camera: Pose
    color: Array  # u1 [H, W, 3] RGB on black
    depth_m: Array  # f4 [H, W], where half the light is absorbed; 0 = nothing there
    opacity: Array  # u1 [H, W], 255 = opaque

    def check(self) -> None:
        require_count("keyframe", self.keyframe)
        require_version(self.version, self.graph_version)
        size = (self.camera.height, self.camera.width)
        self.color.require("color", "u1", (*size, 3))
        self.depth_m.require("depth_m", "f4", size)
        self.depth_m.require_finite("depth_m")
        self.opacity.require("opacity", "u1", size)


MAX_ITERATIONS = 500  # half a minute in which no keyframe is mapped


class RefineMap(Message, frozen=True, kw_only=True):
    """map/refine: asked of the mapper, to fit the map further to the keyframes it has."""

    iterations: int
    initial_rate: float = 1.0  # factor on the length of the first step
    final_rate: float = 1.0  # and of the last one; geometric between

    def check(self) -> None:
        require_count("iterations", self.iterations)
        if self.iterations > MAX_ITERATIONS:
            raise ValueError(f"{self.iterations} iterations: ask for {MAX_ITERATIONS} at a time")
        require_finite("rates", (self.initial_rate, self.final_rate))
        if not (0 < self.initial_rate <= 1 and 0 < self.final_rate <= 1):
            raise ValueError(f"rates {self.initial_rate} and {self.final_rate} must be in (0, 1]")


MAX_NAMES = 256  # what one byte can number


def require_names(names: tuple[str, ...]) -> None:
    if len(names) > MAX_NAMES:
        raise ValueError(f"{len(names)} label_names are over {MAX_NAMES}")
    longest = max(map(len, names), default=0)
    if longest > MAX_LABEL_LENGTH:
        raise ValueError(
            f"a name of {longest} characters in label_names is over {MAX_LABEL_LENGTH}"
        )


def require_weights(labels: Array) -> None:
    """Raise ValueError unless the six numbers of each row [32] are finite and not negative."""
    numbers = np.ascontiguousarray(labels.numpy()[:, :24]).view("<f4")
    if not (np.isfinite(numbers).all() and (numbers >= 0).all()):
        raise ValueError("labels hold weights that are negative, NaN or infinite")


def require_version(version: int, graph_version: int) -> None:
    require_count("version", version)
    require_count("graph_version", graph_version)
