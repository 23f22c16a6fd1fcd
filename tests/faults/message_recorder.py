"""Who listens from outside and says what must not have happened."""

import hashlib
import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import zenoh

from ldo_service.maps.replica import MapReplica
from ldo_service.schemas import (
    GraphCorrection,
    Health,
    Keyframe,
    MapDelta,
    MapSnapshot,
    Message,
    TrackedPose,
    decode,
)
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.flow_control import Credit, Header, decode_request

TAKERS = ("detector", "mapper", "loop_closer", "optimizer")  # of keyframes
KINDS: dict[str, type[Message]] = {
    "keyframe/new": Keyframe,
    "link/again/keyframe/new": Keyframe,
    "graph/correction": GraphCorrection,
    "map/delta": MapDelta,
    "map/snapshot": MapSnapshot,
    "pose/tracked": TrackedPose,
}
BEHIND_S = 5.0  # for what is still on its way
GRANTS = "link/grant/keyframe/new"


@dataclass
class Witness:
    """Across all lives of a service on one state folder. `violations` says what was seen."""

    violations: list[str] = field(default_factory=list)
    made: dict[int, bytes] = field(default_factory=dict)  # keyframe: digest of its message
    numbers: dict[tuple[int, int], int] = field(default_factory=dict)  # epoch, seq: keyframe
    handled: dict[str, tuple[int, int]] = field(default_factory=dict)  # taker: epoch, next seq
    placed: set[int] = field(default_factory=set)  # keyframes of the last correction
    graph_version: int = 0
    map_version: int = 0
    last_delta: tuple[int, int] = (0, -1)  # epoch and number
    pose: TrackedPose | None = None
    first_stamp_ns: int | None = None  # of keyframe 0, whose frame the map's is
    health: dict[str, tuple[float, Health]] = field(default_factory=dict)
    follower: MapReplica = field(default_factory=MapReplica)  # from the first message on
    late: MapReplica = field(default_factory=MapReplica)  # from the last fault on
    _behind_since: float | None = None
    _subscribers: list[object] = field(default_factory=list)
    _heard: deque[tuple[str, bytes, bytes]] = field(default_factory=lambda: deque(maxlen=20_000))

    # --- hearing ----------------------------------------------------------------------------------
    def listen(self, session: zenoh.Session, network: Endpoint) -> None:
        """For as long as the session lives. Who listens now may have missed something."""
        self.follower, self.late = MapReplica(), MapReplica()
        self._subscribers.clear()
        for topic in (*KINDS, GRANTS, "health/*"):
            prefix = network.expression("")

            def store(sample: zenoh.Sample, prefix: str = prefix) -> None:
                attachment = sample.attachment
                header = attachment.to_bytes() if attachment is not None else b""
                topic = str(sample.key_expr).removeprefix(prefix)
                self._heard.append((topic, header, sample.payload.to_bytes()))

            handler = zenoh.handlers.Callback(store, indirect=False)
            expression = network.expression(topic)
            self._subscribers.append(session.declare_subscriber(expression, handler))

    def join_late(self, snapshot: Iterable[Message]) -> None:
        """Follow the map anew, from the last snapshot that there is."""
        self.update()
        self.late = MapReplica()
        for part in snapshot:
            assert isinstance(part, MapSnapshot)
            self.late.apply(part)

    def _follow(self, message: MapDelta | MapSnapshot) -> None:
        self.follower.apply(message)
        self.late.apply(message)

    def update(self) -> None:
        """Judge what came since the last call."""
        while self._heard:
            topic, header, body = self._heard.popleft()
            if topic == GRANTS:
                self._granted(decode_request(memoryview(body)))
            elif topic.startswith("health/"):
                health = decode(body, Health)
                self.health[health.actor] = time.monotonic(), health
            else:
                self._told(decode(body, KINDS[topic]), header, body)

    def _told(self, message: Message, header: bytes, body: bytes) -> None:
        match message:
            case Keyframe():
                self._made(message, decode(header, Header), hashlib.blake2b(body).digest())
            case GraphCorrection():
                self._corrected(message)
            case MapDelta():
                of = decode(header, Header)
                self.last_delta = of.epoch, of.seq
                self._must_grow("map", self.map_version, message.version)
                self.map_version = message.version
                self._follow(message)
            case MapSnapshot():
                self._follow(message)
            case TrackedPose():
                self.pose = message

    # --- judging ----------------------------------------------------------------------------------
    def _made(self, message: Keyframe, header: Header, digest: bytes) -> None:
        if message.keyframe == 0:
            self.first_stamp_ns = message.stamp_ns
        known = self.made.setdefault(message.keyframe, digest)
        if known != digest:
            self.violations.append(f"keyframe {message.keyframe} was made twice")
        number = self.numbers.setdefault((header.epoch, header.seq), message.keyframe)
        if number != message.keyframe:
            self.violations.append(f"number {header.seq} was given to {number} and its successor")

    def _granted(self, grant: object) -> None:
        if isinstance(grant, Credit):
            epoch, handled = self.handled.get(grant.consumer, (grant.epoch, 0))
            if epoch == grant.epoch and grant.handled < handled:
                self.violations.append(
                    f"{grant.consumer} had handled {handled} keyframes, and then {grant.handled}"
                )
            self.handled[grant.consumer] = grant.epoch, grant.handled

    def _corrected(self, message: GraphCorrection) -> None:
        self._must_grow("graph", self.graph_version, message.graph_version)
        self.graph_version = message.graph_version
        ids = message.keyframes.numpy().tolist()
        if len(set(ids)) < len(ids):
            self.violations.append("a keyframe is twice in the graph")
        if lost := self.placed - set(ids):
            self.violations.append(f"the graph lost keyframes {sorted(lost)}")
        self.placed = set(ids)

    def _must_grow(self, what: str, before: int, now: int) -> None:
        if now <= before:
            self.violations.append(f"version {now} of the {what} came after {before}")

    def acknowledged_by(self, taker: str) -> set[int]:
        """Keyframes that a consumer has said to have handled."""
        epoch, handled = self.handled.get(taker, (0, 0))
        return {k for (of, seq), k in self.numbers.items() if of == epoch and seq < handled}

    def has_missed_deltas(self) -> bool:
        """Whether the mapper said a while ago that it sent more than came: the network may lose
        what goes outside."""
        at, mapper = self.health["mapper"]
        sent = {count.topic: count.sent for count in mapper.outputs}["map/delta"]
        epoch, seq = self.last_delta
        came = seq + 1 if mapper.epoch == epoch else 0
        if came >= sent:
            self._behind_since = None
            return False
        self._behind_since = self._behind_since or at
        if time.monotonic() - self._behind_since < BEHIND_S:
            return False
        self.follower.is_behind = self.late.is_behind = True
        return True

    def is_caught_up(self) -> bool:
        """Whether all consumers have handled every keyframe that was seen."""
        return all(self.acknowledged_by(taker) == set(self.made) for taker in TAKERS)

    def repeated(self) -> Iterator[str]:
        """Who took a keyframe twice."""
        for actor, (_, health) in self.health.items():
            if count := health.metrics.get("keyframes_repeated", 0):
                yield f"{actor} took {count:g} keyframes twice"
