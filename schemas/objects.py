"""Objects of the map, and observations of objects in keyframes."""

import itertools

import msgspec

from ldo_service.schemas.detections import MAX_LABEL_LENGTH
from ldo_service.schemas.map import require_version
from ldo_service.schemas.message import Message, require_count, require_finite
from ldo_service.schemas.pose import Pose

MAX_OBJECTS = 10_000
MAX_CLASSES = 32  # Maximum classes of one distribution.
ROUNDING = 1e-3  # Tolerance of a sum of probabilities.

Vector3 = tuple[float, float, float]  # x, y, z.
Box = tuple[float, float, float, float]  # x0, y0, x1, y1 in pixels; pixel centers at integers.
# Names and probabilities of the likeliest classes, in descending order. One minus their sum is the
# probability of `other`, which stands for all classes that are not listed.
Distribution = tuple[tuple[str, float], ...]


class ObjectObservation(Message, frozen=True, kw_only=True):
    """Observation of an object in a keyframe, or a miss, published on object/observation.

    A miss is an object that should be visible in the keyframe but was not detected. stamp_ns is the
    stamp of the keyframe.
    """

    keyframe: int  # Id of the keyframe.
    object: int  # Id of the object, as in map/objects.
    box_px: Box  # Detected box, or for a miss the expected box.
    # Classes of the Gaussians in the box; for a miss, the classes of the object before the miss.
    distribution: Distribution
    entropy: float  # Entropy over all classes, nats; `distribution` lists only the likeliest ones.
    is_miss: bool = False  # True if the object is in view and not occluded, but not detected.

    def check(self) -> None:
        require_count("keyframe", self.keyframe)
        require_count("object", self.object)
        require_box(self.box_px)
        require_distribution(self.distribution)
        require_entropy(self.entropy)


class ObjectView(msgspec.Struct, frozen=True, kw_only=True):
    """Keyframe that shows much of an object, with the object's box in the keyframe's image."""

    keyframe: int
    box_px: Box

    def __post_init__(self) -> None:
        require_count("keyframe", self.keyframe)
        require_box(self.box_px)


class MapObject(msgspec.Struct, frozen=True, kw_only=True):
    """Object in the map frame.

    `id` never changes and is not reused after the object is removed.
    """

    id: int
    name: str  # The likeliest class except background.
    confidence: float  # Probability of the class `name`, 0..1.
    centroid: Vector3  # Mean position of the object's Gaussians, meters.
    # Covariance of the positions of the object's Gaussians: 9 numbers, row-major, m^2.
    covariance: tuple[float, ...]
    T_map_object: Pose  # Center and axes of the object's box.
    size: Vector3  # Size of the box along its axes, meters.
    distribution: Distribution
    entropy: float  # Entropy in nats, as in `ObjectObservation`.
    observation_count: int  # Number of keyframes in which the object was observed.
    miss_count: int  # Number of keyframes in which the object was in view but not detected.
    first_keyframe: int  # First keyframe in which the object was observed.
    last_keyframe: int  # Last keyframe in which the object was observed.
    views: tuple[ObjectView, ...] = ()  # Keyframes that show the object best, the best first.

    def __post_init__(self) -> None:
        for name in ("id", "observation_count", "miss_count", "first_keyframe", "last_keyframe"):
            require_count(name, getattr(self, name))
        if not 0 < len(self.name) <= MAX_LABEL_LENGTH:
            raise ValueError(
                f"name has {len(self.name)} characters, must have 1 to {MAX_LABEL_LENGTH}"
            )
        require_finite("object", (self.confidence, *self.centroid, *self.covariance, *self.size))
        if not 0 <= self.confidence <= 1:
            raise ValueError(f"confidence is {self.confidence:g}, must be within 0..1")
        if len(self.covariance) != 9 or min(self.covariance[::4]) < 0:
            raise ValueError(
                f"covariance is {self.covariance}, must be 9 numbers; those on the diagonal must "
                "be at least 0"
            )
        if min(self.size) < 0:
            raise ValueError(f"size is {self.size}, must not be negative")
        require_distribution(self.distribution)
        require_entropy(self.entropy)


class MapObjects(Message, frozen=True, kw_only=True):
    """Complete list of the objects of the map at `version`, published on map/objects."""

    version: int
    graph_version: int  # Version of the keyframe poses that the objects refer to.
    objects: tuple[MapObject, ...] = ()  # Ascending by id.

    def check(self) -> None:
        require_version(self.version, self.graph_version)
        ids = [one.id for one in self.objects]
        if len(ids) > MAX_OBJECTS:
            raise ValueError(f"message has {len(ids)} objects, must have at most {MAX_OBJECTS}")
        if any(b <= a for a, b in itertools.pairwise(ids)):
            raise ValueError(f"ids of objects start with {ids[:8]}, must be ascending")


def require_box(box_px: Box) -> None:
    """Raise ValueError unless a box is finite with x0 <= x1 and y0 <= y1."""
    require_finite("box_px", box_px)
    x0, y0, x1, y1 = box_px
    if not (x0 <= x1 and y0 <= y1):
        raise ValueError(f"box_px {box_px} is inverted: x0 <= x1 and y0 <= y1 are required")


def require_distribution(distribution: Distribution) -> None:
    """Raise ValueError unless names are unique and probabilities sum to at most 1."""
    weights = [weight for _, weight in distribution]
    require_finite("distribution", weights)
    if not 0 < len(weights) <= MAX_CLASSES:
        raise ValueError(f"distribution has {len(weights)} classes, must have 1 to {MAX_CLASSES}")
    if len({name for name, _ in distribution}) != len(weights):
        raise ValueError("a class occurs twice in the distribution, must occur once")
    if min(weights) < 0 or sum(weights) > 1 + ROUNDING:
        raise ValueError(f"probabilities are {weights}, must not be negative or sum to more than 1")
    if any(not 0 < len(name) <= MAX_LABEL_LENGTH for name, _ in distribution):
        raise ValueError(
            "a class name in the distribution is empty or too long, must have 1 to "
            f"{MAX_LABEL_LENGTH} characters"
        )


def require_entropy(entropy: float) -> None:
    """Raise ValueError unless an entropy is at least 0 and below 100 nats."""
    if not 0 <= entropy < 100:  # Nats; rejects NaN too.
        raise ValueError(f"entropy is {entropy:g} nats, must be at least 0 and below 100")
