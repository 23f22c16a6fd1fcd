"""Mailbox: bounded queue of the messages that arrive for one actor.

The actor takes messages of inputs with priority first, and the other messages in order of arrival.
The mailbox counts each message that it drops.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Mapping
from threading import Lock

import msgspec

from ldo_service import __version__
from ldo_service.schemas import InputCount, decode
from ldo_service.schemas.topics import Topic
from ldo_service.transport.flow_control import (
    EXTERNAL_HEADER,
    MAX_HEADER_BYTES,
    Header,
    InletPosition,
    ProducerHello,
    credit_key,
    data_key,
    encode_link,
    producer_hello_key,
    retransmit_key,
)
from ldo_service.transport.interface import Publisher, Transport, call_soon

from .actor import Backlog, In, Lossless
from .inlet import Delivery, Inlet, LosslessInlet
from .stage_commands import StageCommand
from .supervision_policy import LOG_PERIOD_S, LogLimit

log = logging.getLogger(__name__)

# Maximum size in bytes of all queued messages of inputs with policy `Latest` in one mailbox: one of
# the largest messages. A burst of four raw frames of 1080p has 41 MB. A single message may be
# larger, if `max_bytes` allows it.
MAX_WAITING_BYTES = 64_000_000


class Mailbox:
    """Queue of the messages that arrive for one actor.

    Any thread may add messages; only the event loop takes them. A queued message is a `Delivery`,
    and it counts as handled after `done`. If the process is killed before `done`, a lossless input
    receives the message again after the restart. An input with policy `Latest` loses it.
    """

    def __init__(
        self,
        consumer: str,
        ports: tuple[In, ...],
        transport: Transport,
        max_bytes: int = 64_000_000,
        past: Mapping[str, InletPosition] | None = None,
        *,
        is_held: bool = False,
    ) -> None:
        """Subscribe to the topics of all inputs.

        Args:
            consumer: Name of the actor.
            ports: Inputs of the actor.
            transport: The network.
            max_bytes: Maximum size of a message of an input with policy `Latest`, bytes. Lossless
                inputs have no limit, because their messages come from actors of the service.
            past: Position of the previous process on each lossless topic, by topic name.
            is_held: Begin as after `pause`.
        """
        self._consumer, self._max_bytes = consumer, max_bytes
        self._loop = asyncio.get_running_loop()
        self._lock = Lock()  # Guards all state below that network threads and event loop share.
        self._order: deque[Delivery] = deque()
        self._ready = asyncio.Event()
        self._wake_pending = self._grant_pending = False
        self._closed, self._held = False, is_held
        # False until `resume` if a paused stage starts or is reset: its producers may still have
        # messages of the old run until the reset has reached them.
        self._connects = not is_held
        # True while the stage takes no messages because its state cannot be saved. Producers then
        # do not evict this actor.
        self.waits_for_disk = False
        self._commands: deque[StageCommand] = deque()
        self._grants: dict[str, Publisher] = {}
        self._malformed = LogLimit(LOG_PERIOD_S)
        self._older: set[str] = set()  # Topics whose producer is of a version without nonces.
        self._inlets: dict[str, Inlet] = {}
        for port in ports:
            self._connect(port, transport, (past or {}).get(port.topic.name))
        self.send_credits()

    def _connect(self, port: In, transport: Transport, past: InletPosition | None) -> None:
        topic = port.topic.name
        inlet = LosslessInlet(port) if isinstance(port.policy, Lossless) else Inlet(port)
        self._inlets[topic] = inlet

        def arrived(header: bytes, body: memoryview) -> None:
            self._arrived(inlet, header, body)

        if isinstance(inlet, LosslessInlet):
            link = inlet
            if past is not None:
                link.resume_from(past)
            self._grants[topic] = transport.publisher(credit_key(topic))
            transport.subscribe(
                producer_hello_key(topic), lambda _, body: self._welcomed(link, body)
            )
            own = self._consumer if isinstance(port.policy, Backlog) else ""
            transport.subscribe(retransmit_key(topic, own), arrived)
        transport.subscribe(data_key(topic), arrived)

    # --- arriving, on any thread --------------------------------------------------------------
    def _arrived(self, inlet: Inlet, raw_header: bytes, body: memoryview) -> None:
        header = _read_header(raw_header)
        with self._lock:
            if self._closed:
                return
            if header is not None and not isinstance(inlet, LosslessInlet):
                inlet.number(header)
            if self._held and not isinstance(inlet, LosslessInlet):
                inlet.paused += 1
            elif header is None:
                self._reject(inlet, "malformed header")
            elif excess := self._excess(inlet, body.nbytes):
                self._reject(inlet, excess)
            elif inlet.accept(header):
                self._store(inlet, Delivery(inlet.port, header, body))
            else:
                self._ask_for_grants()

    def _excess(self, inlet: Inlet, size_bytes: int) -> str:
        """Return why a message is too large for its input, or an empty string if it is not."""
        if isinstance(inlet, LosslessInlet):
            return ""
        limit = inlet.port.topic.max_bytes
        if limit is not None and size_bytes > limit:
            return f"its {size_bytes} bytes exceed the {limit} bytes of this topic"
        if size_bytes > self._max_bytes:
            setting = f"service.max_decoded_message_mb={self._max_bytes / 1e6:g}"
            return f"its {size_bytes} bytes exceed {setting}. Raise it, or send smaller images"
        return ""

    def _reject(self, inlet: Inlet, why: str) -> None:
        """Count and log a message that is rejected before it is decoded.

        The caller holds the lock.
        """
        if inlet.rejected == 0:
            log.warning("%s: message of %s rejected: %s. Later rejections are only counted.",
                        self._consumer, inlet.port.topic.name, why)  # fmt: skip
        inlet.rejected += 1

    def _store(self, inlet: Inlet, delivery: Delivery) -> None:
        for displaced in inlet.offer(delivery):
            self._order.remove(displaced)
        self._order.append(delivery)
        if not isinstance(inlet, LosslessInlet):
            self._bound_bytes()
        if not self._wake_pending:  # One notification is enough for any number of messages.
            self._wake_pending = True
            call_soon(self._loop, self._ready.set)

    def _bound_bytes(self) -> None:
        """Drop the oldest message of the largest queue until the queues fit into the limit.

        A single message may wait whatever its size. The caller holds the lock.
        """
        latest = [i for i in self._inlets.values() if not isinstance(i, LosslessInlet)]
        while (
            sum(len(inlet.waiting) for inlet in latest) > 1
            and sum(inlet.waiting_bytes for inlet in latest) > MAX_WAITING_BYTES
        ):
            largest = max(latest, key=lambda inlet: inlet.waiting_bytes)
            self._order.remove(largest.drop_oldest())

    def _welcomed(self, inlet: LosslessInlet, body: memoryview) -> None:
        try:
            welcome = decode(body, ProducerHello)
        except msgspec.DecodeError as error:
            if self._malformed.is_due():
                log.warning("%s: malformed handshake on %s ignored: %s. Do all programs on this "
                            "network run the same version?",
                            self._consumer, inlet.port.topic.name, error)  # fmt: skip
            return
        start = welcome.starts.get(self._consumer)
        with self._lock:
            if not self._connects:
                return
            nonce = (welcome.nonces or {}).get(self._consumer, 0)
            lost = 0 if start is None else inlet.welcome(welcome.epoch, start, nonce)
            if inlet.should_reply():
                self._ask_for_grants()
            if welcome.nonces is None and not inlet.is_connected:
                self._warn_older_version(inlet.port.topic.name)
        if lost:
            log.error(
                "%s: lost %d messages of %s, because the producer no longer has these messages. "
                "Either this actor was evicted as too slow, its backlog was full, or a disk error "
                "destroyed the messages. Reduce the load of this actor, or raise "
                "supervision.evict_after_s or supervision.backlog_mb.",
                self._consumer, lost, inlet.port.topic.name,
            )  # fmt: skip

    def _warn_older_version(self, topic: str) -> None:
        """Log once that a producer is of a version without nonces; the caller holds the lock."""
        if topic not in self._older:
            log.warning(
                "%s: the actor that produces %s is of an older version and does not answer the "
                "handshake of version %s. This input gets no messages from it. Update the program "
                "that runs the actor (`ldo topics` names the actor), and restart it.",
                self._consumer, topic, __version__,
            )  # fmt: skip
        self._older.add(topic)

    def _ask_for_grants(self) -> None:
        """Schedule `send_credits` on the event loop; the caller holds the lock."""
        if not self._grant_pending:
            self._grant_pending = True
            call_soon(self._loop, self.send_credits)

    # --- taking, on the event loop --------------------------------------------------------------
    async def take(self, timeout_s: float | None = None) -> Delivery | StageCommand | None:
        """Wait for the next command or received message, and remove it from the queue.

        Commands come first, then messages of inputs with priority, then the other messages. Among
        equals, the oldest comes first.

        Args:
            timeout_s: Maximum time to wait, seconds; None: no limit.

        Returns:
            A command or a message, or None if the mailbox is closed and empty.

        Raises:
            TimeoutError: Neither a command nor a message arrived within `timeout_s`.
        """
        # `asyncio.wait_for` of Python 3.11 may swallow the cancellation of a stage.
        async with asyncio.timeout(timeout_s):
            return await self._take()

    async def _take(self) -> Delivery | StageCommand | None:
        while True:
            with self._lock:
                self._wake_pending = False
                self._ready.clear()
                if self._commands:
                    return self._commands.popleft()
                if self._order and not self._held:
                    delivery = next((d for d in self._order if d.port.has_priority), self._order[0])
                    self._order.remove(delivery)
                    self._inlets[delivery.port.topic.name].waiting.popleft()
                    return delivery
                if self._closed:
                    return None
            await self._ready.wait()

    def done(self, delivery: Delivery, rejected: bool = False) -> None:
        """Mark a message as handled or rejected, so that the producer does not send it again."""
        inlet = self._inlets[delivery.port.topic.name]
        with self._lock:
            inlet.done(delivery, rejected)
        if isinstance(inlet, LosslessInlet):
            self._send_grant(inlet)

    def past(self, being_handled: Delivery | None = None) -> dict[str, InletPosition]:
        """Return the position on each lossless topic, to be saved with the state of the actor.

        Args:
            being_handled: The message of the current step, which then counts as handled.

        Returns:
            The epoch and the number of the first unhandled message, by topic name.
        """
        with self._lock:
            return {
                topic: inlet.position(
                    being_handled if being_handled and being_handled.port is inlet.port else None
                )
                for topic, inlet in self._inlets.items()
                if isinstance(inlet, LosslessInlet)
            }

    def put_command(self, command: StageCommand) -> list[StageCommand]:
        """Queue a command; `take` returns commands before messages.

        The command `keep` makes the actor copy its saved state. A new `keep` command replaces the
        queued `keep` commands. An actor that was busy for long then copies its state only once.

        Args:
            command: The command.

        Returns:
            The replaced commands.
        """
        replaced = [old for old in self._commands if old.what == command.what == "keep"]
        self._commands = deque(c for c in [*self._commands, command] if c not in replaced)
        self._ready.set()
        return replaced

    def pause(self) -> None:
        """Let `take` return only commands until `resume` is called.

        Meanwhile, inputs with policy `Latest` drop and count their messages. Lossless inputs keep
        their messages in the queue.
        """
        with self._lock:
            self._held = True
            for inlet in self._inlets.values():
                inlet.discard_backlog()
            self._keep_only_waiting()

    def resume(self) -> None:
        """End the pause: let `take` return messages again."""
        with self._lock:
            self._held, is_connecting, self._connects = False, not self._connects, True
        if is_connecting:
            self.send_credits()
        self._ready.set()

    @property
    def is_held(self) -> bool:
        """True while the mailbox is paused."""
        return self._held

    def reset(self) -> None:
        """Clear all queues and connect to the producers again.

        A paused mailbox connects only after `resume`.
        """
        with self._lock:
            self._connects = not self._held
            for inlet in self._inlets.values():
                inlet.reset()
            self._keep_only_waiting()
        self.send_credits()

    def _keep_only_waiting(self) -> None:
        """Remove the deliveries that their inlet has dropped; the caller holds the lock."""
        waiting = {id(d) for inlet in self._inlets.values() for d in inlet.waiting}
        self._order = deque(d for d in self._order if id(d) in waiting)

    def send_credits(self) -> None:
        """Send the credit of each lossless input to its producer.

        The credit is the range of messages that the producer may send. The stage calls this method
        with each heartbeat, because the network may lose a credit message. Until the producer has
        sent its hello, this method sends the hello of the consumer instead of the credit.
        """
        with self._lock:
            self._grant_pending = False
            if not self._connects:
                return
        for inlet in self._inlets.values():
            if isinstance(inlet, LosslessInlet):
                self._send_grant(inlet)

    def _send_grant(self, inlet: LosslessInlet) -> None:
        with self._lock:
            grant = inlet.grant(self._consumer, waits_for_disk=self.waits_for_disk)
        self._grants[inlet.port.topic.name].post(b"", encode_link(grant))

    def close(self) -> None:
        """Accept no more messages; `take` still returns the queued messages."""
        with self._lock:
            self._closed, self._held = True, False
        self._ready.set()

    def disconnect(self) -> None:
        """Close the publishers that send credit messages to the producers."""
        for publisher in self._grants.values():
            publisher.close()

    def waiting(self) -> dict[Topic, int]:
        """Return the number of queued messages of each lossless input, by topic."""
        with self._lock:
            return {
                inlet.port.topic: len(inlet.waiting)
                for inlet in self._inlets.values()
                if isinstance(inlet, LosslessInlet)
            }

    def counts(self) -> tuple[InputCount, ...]:
        """Return the message counters of each input, for the health message of the stage."""
        with self._lock:
            return tuple(inlet.counts() for inlet in self._inlets.values())


def _read_header(raw: bytes) -> Header | None:
    """Decode a header; return None if it is malformed or too long."""
    if len(raw) > MAX_HEADER_BYTES:
        return None
    try:
        return decode(raw, Header) if raw else EXTERNAL_HEADER
    except msgspec.DecodeError:
        return None
