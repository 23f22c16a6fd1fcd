"""Recorder of the published messages of a service that detects violated invariants."""

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

CONSUMERS = ("detector", "mapper", "loop_closer", "optimizer")  # Consumers of keyframes.
KINDS: dict[str, type[Message]] = {
    "keyframe/new": Keyframe,
    "link/again/keyframe/new": Keyframe,
    "link/again/keyframe/new/detector": Keyframe,
    "link/again/keyframe/new/loop_closer": Keyframe,
    "graph/correction": GraphCorrection,
    "map/delta": MapDelta,
    "map/snapshot": MapSnapshot,
    "pose/tracked": TrackedPose,
}
BEHIND_S = 5.0  # Time after which a message that is still missing counts as lost.
CREDITS = "link/grant/keyframe/new"
# The measurements of a keyframe, which the optimizer takes, have the number of the keyframe.
ALL_CREDITS = (CREDITS, "link/grant/keyframe/measurements")


@dataclass
class MessageRecorder:
    """Messages of all processes of a service on one state folder, and violated invariants."""

    violations: list[str] = field(default_factory=list)
    # Digest of the message by keyframe.
    keyframes: dict[int, bytes] = field(default_factory=dict)
    # Keyframe by epoch and sequence number.
    numbers: dict[tuple[int, int], int] = field(default_factory=dict)
    # Epoch and next sequence number by consumer.
    handled: dict[str, tuple[int, int]] = field(default_factory=dict)
    placed: set[int] = field(default_factory=set)  # Keyframes of the last correction.
    graph_version: int = 0
    map_version: int = 0
    last_delta: tuple[int, int] = (0, -1)  # Epoch and sequence number.
    pose: TrackedPose | None = None
    first_stamp_ns: int | None = None  # Stamp of keyframe 0, which defines the map frame.
    health: dict[str, tuple[float, Health]] = field(default_factory=dict)
    replica: MapReplica = field(default_factory=MapReplica)  # Map since the first message.
    late_replica: MapReplica = field(default_factory=MapReplica)  # Map since the last fault.
    _behind_since: float | None = None
    _subscribers: list[object] = field(default_factory=list)
    _received: deque[tuple[str, bytes, bytes]] = field(default_factory=lambda: deque(maxlen=20_000))

    # --- receiving --------------------------------------------------------------------------------
    def listen(self, session: zenoh.Session, network: Endpoint) -> None:
        """Subscribe until the session ends, with empty replicas that may have missed messages."""
        self.replica, self.late_replica = MapReplica(), MapReplica()
        self._subscribers.clear()
        for topic in (*KINDS, *ALL_CREDITS, "health/*"):
            prefix = network.expression("")

            def store(sample: zenoh.Sample, prefix: str = prefix) -> None:
                attachment = sample.attachment
                header = attachment.to_bytes() if attachment is not None else b""
                topic = str(sample.key_expr).removeprefix(prefix)
                self._received.append((topic, header, sample.payload.to_bytes()))

            handler = zenoh.handlers.Callback(store, indirect=False)
            expression = network.expression(topic)
            self._subscribers.append(session.declare_subscriber(expression, handler))

    def join_late(self, snapshot: Iterable[Message]) -> None:
        """Start the late replica again from the last snapshot."""
        self.update()
        self.late_replica = MapReplica()
        for part in snapshot:
            assert isinstance(part, MapSnapshot)
            self.late_replica.apply(part)

    def _follow(self, message: MapDelta | MapSnapshot) -> None:
        self.replica.apply(message)
        self.late_replica.apply(message)

    def update(self) -> None:
        """Check the messages received since the last call."""
        while self._received:
            topic, header, body = self._received.popleft()
            if topic in ALL_CREDITS:
                self.add_credit(decode_request(memoryview(body)))
            elif topic.startswith("health/"):
                health = decode(body, Health)
                self.health[health.actor] = time.monotonic(), health
            else:
                self._handle(decode(body, KINDS[topic]), header, body)

    def _handle(self, message: Message, header: bytes, body: bytes) -> None:
        match message:
            case Keyframe():
                self.add_keyframe(message, decode(header, Header), body)
            case GraphCorrection():
                self._add_correction(message)
            case MapDelta():
                of = decode(header, Header)
                self.last_delta = of.epoch, of.seq
                self.must_grow("map", self.map_version, message.version)
                self.map_version = message.version
                self._follow(message)
            case MapSnapshot():
                self._follow(message)
            case TrackedPose():
                self.pose = message

    # --- invariants -------------------------------------------------------------------------------
    def add_keyframe(self, message: Keyframe, header: Header, body: bytes) -> None:
        """Check that a keyframe and its number belong to one message."""
        digest = hashlib.blake2b(body).digest()
        if message.keyframe == 0:
            self.first_stamp_ns = message.stamp_ns
        known = self.keyframes.setdefault(message.keyframe, digest)
        if known != digest:
            self.violations.append(f"keyframe {message.keyframe} was made twice")
        number = self.numbers.setdefault((header.epoch, header.seq), message.keyframe)
        if number != message.keyframe:
            self.violations.append(f"number {header.seq} was given to {number} and its successor")

    def add_credit(self, grant: object) -> None:
        """Check that a consumer has not handled fewer keyframes than before."""
        if isinstance(grant, Credit):
            epoch, handled = self.handled.get(grant.consumer, (grant.epoch, 0))
            if epoch == grant.epoch and grant.handled < handled:
                self.violations.append(
                    f"{grant.consumer} had handled {handled} keyframes, and then {grant.handled}"
                )
            self.handled[grant.consumer] = grant.epoch, grant.handled

    def _add_correction(self, message: GraphCorrection) -> None:
        self.must_grow("graph", self.graph_version, message.graph_version)
        self.graph_version = message.graph_version
        ids = message.keyframes.numpy().tolist()
        if len(set(ids)) < len(ids):
            self.violations.append("a keyframe is twice in the graph")
        if lost := self.placed - set(ids):
            self.violations.append(f"the graph lost keyframes {sorted(lost)}")
        self.placed = set(ids)

    def must_grow(self, what: str, before: int, now: int) -> None:
        """Check that a version is larger than the one before."""
        if now <= before:
            self.violations.append(f"version {now} of the {what} came after {before}")

    def acknowledged_by(self, consumer: str) -> set[int]:
        """Return the keyframes that a consumer has acknowledged."""
        epoch, handled = self.handled.get(consumer, (0, 0))
        return {k for (of, seq), k in self.numbers.items() if of == epoch and seq < handled}

    def has_missed_deltas(self) -> bool:
        """Return whether map deltas that the mapper sent some time ago were not received.

        The network may lose messages to external subscribers.
        """
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
        self.replica.is_behind = self.late_replica.is_behind = True
        return True

    def is_caught_up(self) -> bool:
        """Return whether all consumers have handled every received keyframe."""
        return all(self.acknowledged_by(consumer) == set(self.keyframes) for consumer in CONSUMERS)

    def repeated(self) -> Iterator[str]:
        """Yield a violation for each actor that handled a keyframe twice."""
        for actor, (_, health) in self.health.items():
            if count := health.metrics.get("keyframes_repeated", 0):
                yield f"{actor} took {count:g} keyframes twice"
