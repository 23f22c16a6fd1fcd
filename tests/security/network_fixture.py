"""Router of a robot with keys for each role, which records all messages that arrive."""

import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import zenoh

from ldo_service.schemas.topics import CONTROL, TOPICS
from ldo_service.transport.access_control import Role
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.keys import TlsKeys
from ldo_service.transport.zenoh_transport import open_session
from tests.ports import free_port

ROBOT, OTHER_ROBOT = "mule", "goat"
MAX_MB = 1
STEP_S, PATIENCE_S = 0.01, 60.0
SETTLED = "settled"
# Keys of a camera: recreated ones, a copy of the revoked ones, and expired ones.
LOST, STOLEN, EXPIRED = "lost", "stolen", "expired"
ROLES: tuple[Role, ...] = ("service", "camera", "odometry", "viewer", "operator")
# Topics between actors.
INSIDE = ("link/command", "link/grant/keyframe/new", "link/welcome/keyframe/new")
NAMES = (*(f"{t.name}/mapper" if t.is_per_actor else t.name for t in TOPICS), *INSIDE, SETTLED)


@dataclass
class Lab:
    folder: Path
    network: Endpoint
    session: zenoh.Session
    got: list[tuple[str, int]] = field(default_factory=list)  # Topic and size of each message.

    def keys(self, name: str) -> Endpoint:
        return Endpoint(ROBOT, self.network.endpoint, TlsKeys(self.folder / name))

    def through(self, act: Callable[[], None], *expected: str) -> list[str]:
        """Call `act`, and return the topics on which its messages arrive.

        Waits for all `expected` topics, and then for a later message of the service.
        """
        self.got.clear()
        act()
        eventually(lambda: set(expected) <= {topic for topic, _ in self.got})
        with open_session(self.keys("service")) as service:

            def is_settled() -> bool:
                service.put(f"ldo/{ROBOT}/{SETTLED}", b"")
                return any(topic == SETTLED for topic, _ in self.got)

            eventually(is_settled)
        return sorted({topic for topic, _ in self.got} - {SETTLED})


@contextmanager
def lab(folder: Path) -> Iterator[Lab]:
    """Create an authority in `folder` with keys for each role, and run a router with them."""
    authority = CertificateAuthority.new(folder, days=2)
    for role in (*ROLES, LOST):
        authority.add(role, role if role in ROLES else "camera", ROBOT, days=1)
    shutil.copytree(folder / LOST, folder / STOLEN)
    authority.remove(LOST)
    authority.add(LOST, "camera", ROBOT, days=1)
    authority.add(EXPIRED, "camera", ROBOT, days=1, now=datetime.now(UTC) - timedelta(days=2))
    endpoint = f"tls/127.0.0.1:{free_port()}"
    network = Endpoint(ROBOT, endpoint, TlsKeys(folder / "service"), MAX_MB)
    with open_session(network, router=True) as session:
        here = Lab(folder, network, session)

        def store(sample: zenoh.Sample) -> None:
            topic = str(sample.key_expr).split("/", 2)[2]
            here.got.append((topic, len(sample.payload.to_bytes())))

        def answer(request: zenoh.Query) -> None:
            with request:
                request.reply(f"ldo/{ROBOT}/{CONTROL.name}", b"obeyed")

        for name in NAMES:
            session.declare_subscriber(f"ldo/*/{name}", direct(store))
        session.declare_queryable(f"ldo/{ROBOT}/{CONTROL.name}", direct(answer))
        yield here


def direct(call: Callable[[Any], None]) -> Any:
    return zenoh.handlers.Callback(call, indirect=False)


def puts(network: Endpoint, *topics: str, robot: str = ROBOT, size: int = 3) -> Callable[[], None]:
    """Return a function that connects and puts a message on each topic."""

    def act() -> None:
        with open_session(network) as session:
            for topic in topics:
                session.put(f"ldo/{robot}/{topic}", bytes(size))

    return act


def received_topics(
    lab_: Lab, network: Endpoint, expressions: Sequence[str], *expected: str
) -> list[str]:
    """Return the topics that a subscriber receives while messages are put on every topic.

    Waits until all `expected` topics and a message for the service were received.
    """
    seen: set[str] = set()
    last = threading.Event()
    with open_session(network) as session, open_session(lab_.keys("service")) as service:
        for expression in expressions:
            session.declare_subscriber(
                f"ldo/{ROBOT}/{expression}",
                direct(lambda sample: seen.add(str(sample.key_expr).split("/", 2)[2])),
            )
        service.declare_subscriber(f"ldo/{ROBOT}/{SETTLED}", direct(lambda _sample: last.set()))

        def is_received() -> bool:
            for name in NAMES:
                lab_.session.put(f"ldo/{ROBOT}/{name}", b"1")
            return set(expected) <= seen and last.is_set()

        eventually(is_received)
    return sorted(seen)


def eventually(true: Callable[[], bool]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not true() and time.monotonic() < until_s:
        time.sleep(STEP_S)


def query(network: Endpoint, expression: str) -> list[bytes]:
    """Return the replies to a query."""
    with open_session(network) as session:
        replies = session.get(f"ldo/{ROBOT}/{expression}", timeout=PATIENCE_S)
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
