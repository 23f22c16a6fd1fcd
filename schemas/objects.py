"""The objects of the map, and where a keyframe shows them."""

import itertools

import msgspec

from ldo_service.schemas.detections import MAX_LABEL_LENGTH
from ldo_service.schemas.map import require_version
from ldo_service.schemas.message import Message, require_count, require_finite
from ldo_service.schemas.pose import Pose

MAX_OBJECTS = 10_000
MAX_CLASSES = 32  # of one distribution
ROUNDING = 1e-3  # of a sum of probabilities

Vector3 = tuple[float, float, float]
Box = tuple[float, float, float, float]  # x0, y0, x1, y1 px, pixel centres at integers
Distribution = tuple[
    tuple[str, float], ...
]  # name and probability, heaviest first; what is missing
# from a sum of one belongs to `other`, and a class that is missing is not impossible


class ObjectObservation(Message, frozen=True, kw_only=True):
    """object/observation: an object that a keyframe shows, or ought to. stamp_ns is that of the
    keyframe."""

    keyframe: int  # id
    object: int  # id, as in map/objects
    box_px: Box  # that was detected; of a miss where the object should be
    distribution: Distribution  # of the Gaussians in that box; of a miss what was known before
    entropy: float  # of it, nats, before it was cut to its heaviest classes
    is_miss: bool = False  # in view, not hidden, and not detected

    def check(self) -> None:
        require_count("keyframe", self.keyframe)
        require_count("object", self.object)
        require_box(self.box_px)
        require_distribution(self.distribution)
        require_entropy(self.entropy)


class ObjectView(msgspec.Struct, frozen=True, kw_only=True):
    """A keyframe that shows much of an object, and its box there."""

    keyframe: int
    box_px: Box

    def __post_init__(self) -> None:
        require_count("keyframe", self.keyframe)
        require_box(self.box_px)


class MapObject(msgspec.Struct, frozen=True, kw_only=True):
    """An object, in the map frame. `id` stays, and is not given again after the object is gone."""

    id: int
    name: str  # the heaviest class but background
    confidence: float  # 0..1, its probability
    centroid: Vector3  # mean of its Gaussians, metres
    covariance: tuple[float, ...]  # of their means: 9 numbers, row-major, m^2
    T_map_object: Pose  # centre and axes of its box
    size: Vector3  # of the box along these axes, metres
    distribution: Distribution
    entropy: float  # nats, see `ObjectObservation`
    observation_count: int  # keyframes
    miss_count: int  # keyframes that ought to have seen it
    first_keyframe: int  # that saw it
    last_keyframe: int
    views: tuple[ObjectView, ...] = ()  # best first

    def __post_init__(self) -> None:
        for name in ("id", "observation_count", "miss_count", "first_keyframe", "last_keyframe"):
            require_count(name, getattr(self, name))
        if not 0 < len(self.name) <= MAX_LABEL_LENGTH:
            raise ValueError(f"a name of {len(self.name)} characters: 1 to {MAX_LABEL_LENGTH}")
        require_finite("object", (self.confidence, *self.centroid, *self.covariance, *self.size))
        if not 0 <= self.confidence <= 1:
            raise ValueError(f"confidence {self.confidence:g} must be within 0..1")
        if len(self.covariance) != 9 or min(self.covariance[::4]) < 0:
            raise ValueError(
                f"covariance {self.covariance} must be 9 numbers, variances at least 0"
            )
        if min(self.size) < 0:
            raise ValueError(f"size {self.size} must not be negative")
        require_distribution(self.distribution)
        require_entropy(self.entropy)


class MapObjects(Message, frozen=True, kw_only=True):
    """map/objects: all of them, as of `version` of the map."""

    version: int
    graph_version: int  # of the keyframe poses that they are expressed through
    objects: tuple[MapObject, ...] = ()  # by id

    def check(self) -> None:
        require_version(self.version, self.graph_version)
        ids = [one.id for one in self.objects]
        if len(ids) > MAX_OBJECTS:
            raise ValueError(f"{len(ids)} objects are over {MAX_OBJECTS}")
        if any(b <= a for a, b in itertools.pairwise(ids)):
            raise ValueError("ids of objects must be ascending")


def require_box(box_px: Box) -> None:
    require_finite("box_px", box_px)
    x0, y0, x1, y1 = box_px
    if not (x0 <= x1 and y0 <= y1):
        raise ValueError(f"box {box_px} is turned inside out")


def require_distribution(distribution: Distribution) -> None:
    weights = [weight for _, weight in distribution]
    require_finite("distribution", weights)
    if not 0 < len(weights) <= MAX_CLASSES:
        raise ValueError(f"a distribution over {len(weights)} classes: 1 to {MAX_CLASSES}")
    if len({name for name, _ in distribution}) != len(weights):
        raise ValueError("a distribution names a class twice")
    if min(weights) < 0 or sum(weights) > 1 + ROUNDING:
        raise ValueError(f"probabilities {weights} must not be negative, nor sum to more than 1")
    if any(not 0 < len(name) <= MAX_LABEL_LENGTH for name, _ in distribution):
        raise ValueError(f"names of classes have 1 to {MAX_LABEL_LENGTH} characters")


def require_entropy(entropy: float) -> None:
    if not 0 <= entropy < 100:  # nats; NaN is refused too
        raise ValueError(
            f"entropy {entropy:g} must be at least 0, and is at most log of the classes"
        )
