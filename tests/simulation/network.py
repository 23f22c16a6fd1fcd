"""Simulated network: links between processes with delay, loss, duplication and partitions."""

import random
from collections.abc import Awaitable, Callable, Collection, Sequence
from contextvars import Context
from dataclasses import dataclass
from enum import Enum

from ldo_service.transport.flow_control import data_key, retransmit_key
from ldo_service.transport.interface import LastValues, OnMessage, OnPresence
from ldo_service.transport.zenoh_transport import LEASE_MS

from .virtual_loop import CURRENT, Process, VirtualLoop, is_current_dead

# Time that a publisher needs for a message, seconds.
SEND_S = (0.0001, 0.001)
DELAY_S = (0.0001, 0.003)  # Delay of an undisturbed link, seconds.
TICK_S = 1e-6  # Minimum time between two messages of a link, so that they stay in order, seconds.
# Time after which a link that delivers nothing counts as broken, seconds: the lease of Zenoh.
LEASE_S = LEASE_MS / 1000
DRIVER = Context()  # Context of callbacks that belong to no process.
DISCONNECTED_AFTER_S = 0.05  # Time until the others notice that a process has ended, seconds.
# Time from the end of a partition of two hosts until their connections that were broken are open
# again, seconds: TCP waits up to 4 s between two attempts to open a connection.
RECONNECT_S = (0.0, 4.0)


class Way(Enum):
    """Direction between the host of the service and that of the remote actors."""

    OUT = "to the remote actors"
    BACK = "from the remote actors"


@dataclass
class Disturbance:
    """Disturbance of some links.

    Attributes:
        source: Name of the sending process; empty for all processes.
        target: Name of the receiving process; empty for all processes.
        topic: Topic whose messages are disturbed, but not their credits; empty for all messages. A
            congested network drops large messages and delivers small ones.
        loss: Probability that a message is lost.
        ways: Directions between the two hosts whose messages are disturbed; empty for all messages.
        delay_s: Maximum additional delay, seconds.
        min_delay_s: Minimum additional delay, seconds.
        duplication: Probability that a message arrives twice.
        reorders: Whether a message may overtake an earlier one.
    """

    source: str = ""
    target: str = ""
    topic: str = ""
    ways: frozenset[Way] = frozenset()
    loss: float = 0.0
    delay_s: float = 0.0
    min_delay_s: float = 0.0
    duplication: float = 0.0
    reorders: bool = False

    def concerns(self, source: str, target: str, key: str, way: Way | None) -> bool:
        """Return whether this disturbance concerns messages of a key on a link.

        Args:
            source: Name of the sending process.
            target: Name of the receiving process.
            key: Key of the message.
            way: Direction of the link; None for a link between processes of one host.
        """
        if self.ways:
            return way in self.ways
        if self.topic:
            return key == data_key(self.topic) or key.startswith(retransmit_key(self.topic))
        return self.source in ("", source) and self.target in ("", target)


class SimulatedNetwork:
    """Network between all processes.

    Attributes:
        disturbances: The disturbances of the present.
    """

    def __init__(
        self,
        loop: VirtualLoop,
        seed: int,
        observe: Callable[[str, bytes, bytes], None],
        remote: Collection[str] = (),
    ) -> None:
        """Create a network without processes.

        Args:
            loop: The event loop of all processes.
            seed: Seed of delays and losses.
            observe: Called with key, header and body of each message when it is sent.
            remote: Names of the processes on the other host.
        """
        self._remote, self._cut_ways = frozenset(remote), set[Way]()
        self._host_partitions, self._are_hosts_apart = 0, False
        self.loop, self.rng, self.observe = loop, random.Random(f"{seed} network"), observe
        self.disturbances: list[Disturbance] = []
        self._cut: dict[str, int] = {}  # Number of the partition, by name of the process.
        self._is_lease_over: set[str] = set()
        self._partitions = self.connections = 0
        self.transports: list[SimulatedTransport] = []

    def transport(self, name: str) -> "SimulatedTransport":
        """Return the connection of the current process, which has the given name."""
        transport = SimulatedTransport(self, name, CURRENT.get())
        self.transports.append(transport)
        return transport

    # --- partitions -----------------------------------------------------------------------------
    def partition(self, name: str) -> None:
        """Cut a process off from all others; a long cut ends the liveliness of both sides."""
        self._partitions += 1
        self._cut[name] = number = self._partitions
        self.loop.call_later(LEASE_S, self._end_lease, name, number)

    def cut_hosts(self, ways: Collection[Way]) -> None:
        """Lose all messages between the two hosts in some directions, until `join_hosts`."""
        self._host_partitions += 1
        self._cut_ways = set(ways)
        self.loop.call_later(LEASE_S, self._break_connections, self._host_partitions)

    def _break_connections(self, number: int) -> None:
        """Close the connections between the hosts, because one of them has heard nothing."""
        if self._host_partitions == number and self._cut_ways:
            self._cut_ways, self._are_hosts_apart = set(Way), True
            self._tell_hosts(is_alive=False)

    def join_hosts(self) -> None:
        """End the partition between the two hosts; broken connections open a little later."""
        self._host_partitions += 1
        if self._are_hosts_apart:
            number = self._host_partitions
            self.loop.call_later(self.rng.uniform(*RECONNECT_S), self._reconnect, number)
        else:
            self._cut_ways.clear()

    def _reconnect(self, number: int) -> None:
        if self._host_partitions == number:
            self._cut_ways.clear()
            self._are_hosts_apart = False
            self._tell_hosts(is_alive=True)

    def _tell_hosts(self, *, is_alive: bool) -> None:
        """Tell each host about the liveliness of the actors of the other one."""
        for watcher in self.transports:
            for other in self.transports:
                if self._way(other.name, watcher.name):
                    for token in other.tokens:
                        watcher.notify(token, is_alive=is_alive)

    def _way(self, source: str, target: str) -> Way | None:
        """Return the direction of a link between the hosts; None for a link in one host."""
        if (source in self._remote) == (target in self._remote):
            return None
        return Way.BACK if source in self._remote else Way.OUT

    def heal(self) -> None:
        """End all partitions and disturbances, except a partition of the two hosts."""
        over, self._is_lease_over = self._is_lease_over, set()
        self._cut.clear()
        self.disturbances.clear()
        for name in sorted(over):
            self._tell_about(name, is_alive=True)

    def _end_lease(self, name: str, number: int) -> None:
        if self._cut.get(name) == number:
            self._is_lease_over.add(name)
            self._tell_about(name, is_alive=False)

    def _tell_about(self, name: str, *, is_alive: bool) -> None:
        """Tell both sides of a partition about the liveliness of the other one."""
        for watcher in self.transports:
            for other in self.transports:
                if (watcher.name == name) != (other.name == name):
                    for token in other.tokens:
                        watcher.notify(token, is_alive=is_alive)

    def is_cut(self, source: str, target: str) -> bool:
        """Return whether a partition is between two processes."""
        if self._way(source, target) in self._cut_ways:
            return True
        return source != target and (source in self._cut or target in self._cut)

    # --- messages -------------------------------------------------------------------------------
    def send(self, publisher: "SimulatedPublisher", header: bytes, body: bytes) -> None:
        """Deliver a message to all subscribers, each after the delay of its link."""
        key, source = publisher.key, publisher.transport.name
        self.observe(key, header, body)
        for transport in self.transports:
            for number, on_message in enumerate(transport.subscribers.get(key, ())):
                self._deliver(publisher, transport, (number, on_message), header, body, source)

    def _deliver(
        self,
        publisher: "SimulatedPublisher",
        transport: "SimulatedTransport",
        subscriber: tuple[int, OnMessage],
        header: bytes,
        body: bytes,
        source: str,
    ) -> None:
        rng, target = self.rng, transport.name
        if self.is_cut(source, target):
            return
        delay_s, copies, reorders = rng.uniform(*DELAY_S), 1, False
        way = self._way(source, target)
        for disturbance in self.disturbances:
            if disturbance.concerns(source, target, publisher.key, way):
                if rng.random() < disturbance.loss:
                    return
                longer_s = disturbance.delay_s - disturbance.min_delay_s
                delay_s += disturbance.min_delay_s + longer_s * rng.random()
                copies += rng.random() < disturbance.duplication
                reorders = reorders or disturbance.reorders
        link = transport.number, subscriber[0]
        for _ in range(copies):
            due_s = self.loop.time() + delay_s
            if not reorders:
                due_s = max(due_s, publisher.last_s.get(link, 0.0) + TICK_S)
                publisher.last_s[link] = due_s
            self.loop.call_at(
                due_s, transport.receive, subscriber[1], header, body, context=transport.context
            )

    def tell_presence(self, name: str, *, is_alive: bool, source: str) -> None:
        """Tell all processes that can hear `source` whether an actor runs."""
        for transport in self.transports:
            if not self.is_cut(source, transport.name):
                transport.notify(name, is_alive=is_alive)

    def is_alive(self, name: str) -> bool:
        """Return whether a running process has declared an actor."""
        return any(name in transport.tokens for transport in self.transports)


class SimulatedTransport:
    """Connection of one process to the network; it implements `Transport`."""

    def __init__(self, network: SimulatedNetwork, name: str, process: Process | None) -> None:
        self.network, self.name = network, name
        network.connections += 1
        self.number = network.connections
        self.context = process.context if process else DRIVER
        self.subscribers: dict[str, list[OnMessage]] = {}
        self.tokens: list[str] = []
        self._watchers: list[OnPresence] = []
        if process:
            process.on_end.append(self.close)

    def publisher(self, key: str) -> "SimulatedPublisher":
        """Create a publisher on a key."""
        return SimulatedPublisher(self, key)

    def subscribe(self, key: str, on_message: OnMessage) -> None:
        """Subscribe to a key."""
        self.subscribers.setdefault(key, []).append(on_message)

    def receive(self, on_message: OnMessage, header: bytes, body: bytes) -> None:
        """Take a message from the network."""
        if self in self.network.transports:
            on_message(header, memoryview(body))

    def declare_liveliness(self, name: str) -> None:
        """Declare an actor alive until this process ends."""
        if not is_current_dead():
            self.tokens.append(name)
            self.network.tell_presence(name, is_alive=True, source=self.name)

    def watch_liveliness(self, on_presence: OnPresence) -> None:
        """Subscribe to the liveliness of all actors."""
        self._watchers.append(on_presence)
        for other in self.network.transports:
            if not self.network.is_cut(other.name, self.name):
                for name in other.tokens:
                    self._notify(on_presence, name, is_alive=True)

    def notify(self, name: str, *, is_alive: bool) -> None:
        """Tell the watchers of this process whether an actor runs."""
        for on_presence in self._watchers:
            self._notify(on_presence, name, is_alive=is_alive)

    def _notify(self, on_presence: OnPresence, name: str, *, is_alive: bool) -> None:
        loop, delay_s = self.network.loop, DELAY_S[1]
        loop.call_later(delay_s, on_presence, name, is_alive, context=self.context)

    def serve_queries(self, key: str, last_values: LastValues) -> None:
        """Do nothing: no program of the simulation asks for last values."""

    def close(self) -> None:
        """End all subscriptions; the others notice the end of the tokens a little later."""
        if self not in self.network.transports:
            return
        self.network.transports.remove(self)
        tokens, self.tokens = self.tokens, []
        self.subscribers.clear()
        self._watchers.clear()

        def disconnect(network: SimulatedNetwork, names: Sequence[str], source: str) -> None:
            for name in names:
                if not network.is_alive(name):
                    network.tell_presence(name, is_alive=False, source=source)

        self.network.loop.call_later(
            DISCONNECTED_AFTER_S, disconnect, self.network, tokens, self.name, context=DRIVER
        )


class SimulatedPublisher:
    """Publisher on one key; it implements `Publisher`."""

    def __init__(self, transport: SimulatedTransport, key: str) -> None:
        self.transport, self.key = transport, key
        self.last_s: dict[tuple[int, int], float] = {}  # Time of the last delivery, by link.
        self._sent_s = 0.0  # Time at which the last message is sent.
        self._posted: tuple[bytes, bytes] | None = None
        self._is_closed = False

    def send(self, header: bytes, body: bytes) -> Awaitable[None]:
        """Send a message; the returned future is done when it was sent."""
        done = self.transport.network.loop.create_future()

        def put() -> None:
            self._put(header, body)
            if not done.done():
                done.set_result(None)

        if self._is_closed:
            done.cancel()
        else:
            self._schedule(put)
        return done

    def post(self, header: bytes, body: bytes) -> None:
        """Send a message without waiting; it replaces an earlier one that was not sent yet."""
        is_under_way, self._posted = self._posted is not None, (header, body)
        if not is_under_way and not self._is_closed:
            self._schedule(self._put_posted)

    def _put_posted(self) -> None:
        posted, self._posted = self._posted, None
        if posted is not None:
            self._put(*posted)

    def _schedule(self, put: Callable[[], None]) -> None:
        network = self.transport.network
        sent_s = network.loop.time() + network.rng.uniform(*SEND_S)
        self._sent_s = max(sent_s, self._sent_s + TICK_S)
        network.loop.call_at(self._sent_s, put)

    def _put(self, header: bytes, body: bytes) -> None:
        if self.transport in self.transport.network.transports and not is_current_dead():
            self.transport.network.send(self, header, bytes(body))

    def close(self) -> None:
        """Accept no more messages."""
        self._is_closed = True
