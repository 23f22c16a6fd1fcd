"""Attempts of unauthorized and faulty programs on the network, with their expected results.

Each attempt runs against a real router and returns its result in the words of `expected`.
"""

import asyncio
import json
import threading
from unittest.mock import patch

import zenoh

from ldo_service.errors import ConfigError
from ldo_service.runtime.actor import Latest
from ldo_service.schemas import encode
from ldo_service.schemas.topics import CAMERA_RGBD, CONTROL, TOPICS
from ldo_service.transport import zenoh_transport
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.flow_control import ALIVE
from ldo_service.transport.keys import TlsKeys
from ldo_service.transport.zenoh_transport import ZenohTransport, open_session
from tests.runtime import fake_actors

from .attempt import Attempt, kept_in
from .network_fixture import (
    EXPIRED,
    INSIDE,
    LOST,
    MAX_MB,
    NAMES,
    OTHER_ROBOT,
    ROBOT,
    SETTLED,
    STOLEN,
    Lab,
    direct,
    eventually,
    puts,
    query,
    received_topics,
)

NOTHING, NO_CONNECTION, NO_ANSWER = "nothing comes through", "no connection", "no answer"
READABLE = sorted(set(NAMES) - {CONTROL.name, SETTLED, *INSIDE})
ALL_BUT_CONTROL = f"{len(READABLE)} of {len(TOPICS)} topics, without control and links"
FLOOD = 3000  # Number of messages.
ATTEMPTS: list[Attempt[Lab]] = []
attempt = kept_in(ATTEMPTS)


def topics(found: list[str]) -> str:
    return ALL_BUT_CONTROL if found == READABLE else ", ".join(found) or NOTHING


def connecting(network: Endpoint) -> str:
    """Return "connected", or NO_CONNECTION with the reason if the error gives one."""
    try:
        with patch.object(zenoh_transport, "CONNECT_WITHIN_MS", 500), open_session(network):
            return "connected"
    except ConfigError as error:
        why = str(error).partition(" accept each other: ")[2].partition(". ")[0]
        return f"{NO_CONNECTION}: {why}" if why else NO_CONNECTION


# --- connections ----------------------------------------------------------------------------------
@attempt("connect without TLS", NO_CONNECTION)
def without_tls(lab: Lab) -> str:
    return connecting(Endpoint(ROBOT, lab.network.endpoint.replace("tls/", "tcp/")))


@attempt("connect without a certificate", NO_CONNECTION)
def without_certificate(lab: Lab) -> str:
    settings = {
        "mode": "client",
        "connect/endpoints": [lab.network.endpoint],
        "connect/timeout_ms": 500,
        "transport/link/tls/root_ca_certificate": str(lab.folder / "ca.crt"),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        with zenoh.open(config):
            return "connected"
    except zenoh.ZError:
        return NO_CONNECTION


@attempt("connect with a certificate of another authority", f"{NO_CONNECTION}: UNKNOWN_CA")
def other_authority(lab: Lab) -> str:
    return connecting(foreign_camera(lab, trusts_ours=True)).replace("TLSV1_ALERT_", "")


@attempt(
    "connect a camera to a router of another authority",
    f"{NO_CONNECTION}: unable to get local issuer certificate",
)
def router_of_another(lab: Lab) -> str:
    return connecting(foreign_camera(lab, trusts_ours=False))


@attempt("connect with a certificate that has expired", f"{NO_CONNECTION}: CERTIFICATE_EXPIRED")
def expired(lab: Lab) -> str:
    return connecting(lab.keys(EXPIRED)).replace("SSLV3_ALERT_", "")


@attempt("put a frame with revoked keys", NOTHING)
def stolen(lab: Lab) -> str:
    return topics(lab.through(puts(lab.keys(STOLEN), CAMERA_RGBD.name)))


@attempt("put a frame with the keys that replaced them", CAMERA_RGBD.name)
def made_again(lab: Lab) -> str:
    return topics(lab.through(puts(lab.keys(LOST), CAMERA_RGBD.name), CAMERA_RGBD.name))


def foreign_camera(lab: Lab, trusts_ours: bool) -> Endpoint:
    """Return the endpoint of a camera with keys of another authority."""
    folder = lab.folder.with_name(f"foreign {trusts_ours}")
    if not folder.exists():
        CertificateAuthority.new(folder, days=2).add("camera", "camera", ROBOT, days=1)
    if trusts_ours:
        (folder / "camera" / "ca.crt").write_bytes((lab.folder / "ca.crt").read_bytes())
    return Endpoint(ROBOT, lab.network.endpoint, TlsKeys(folder / "camera"))


# --- permissions of each role ---------------------------------------------------------------------
@attempt("a camera puts on every topic", "camera/color, camera/depth, camera/rgbd")
def camera_puts(lab: Lab) -> str:
    expected = ("camera/color", "camera/depth", "camera/rgbd")
    return topics(lab.through(puts(lab.keys("camera"), *NAMES), *expected))


@attempt("an odometry puts on every topic", "odometry/prior")
def odometry_puts(lab: Lab) -> str:
    return topics(lab.through(puts(lab.keys("odometry"), *NAMES), "odometry/prior"))


@attempt("a viewer puts on every topic", NOTHING)
def viewer_puts(lab: Lab) -> str:
    return topics(lab.through(puts(lab.keys("viewer"), *NAMES)))


@attempt("an operator puts on every topic", "label/add, map/refine")
def operator_puts(lab: Lab) -> str:
    expected = ("label/add", "map/refine")
    return topics(lab.through(puts(lab.keys("operator"), *NAMES), *expected))


@attempt("a camera puts frames for another robot", NOTHING)
def camera_of_another(lab: Lab) -> str:
    frames = puts(lab.keys("camera"), CAMERA_RGBD.name, robot=OTHER_ROBOT)
    return topics(lab.through(frames))


@attempt("a service puts on the topics of another robot", NOTHING)
def service_of_another(lab: Lab) -> str:
    return topics(lab.through(puts(lab.keys("service"), *NAMES, robot=OTHER_ROBOT)))


@attempt("a camera subscribes to every topic", NOTHING)
def camera_reads(lab: Lab) -> str:
    return topics(received_topics(lab, lab.keys("camera"), NAMES))


@attempt("a viewer subscribes to every topic", ALL_BUT_CONTROL)
def viewer_reads(lab: Lab) -> str:
    return topics(received_topics(lab, lab.keys("viewer"), NAMES, *READABLE))


@attempt("a viewer subscribes to `**` of its robot", NOTHING)
def viewer_reads_wildcard(lab: Lab) -> str:
    return topics(received_topics(lab, lab.keys("viewer"), ["**"]))


@attempt("a viewer subscribes to the topics between actors", NOTHING)
def viewer_reads_links(lab: Lab) -> str:
    return topics(received_topics(lab, lab.keys("viewer"), ["link/**", *INSIDE]))


@attempt("a camera controls", NO_ANSWER)
def camera_controls(lab: Lab) -> str:
    return answers(query(lab.keys("camera"), CONTROL.name))


@attempt("a viewer controls, by name and by wildcard", NO_ANSWER)
def viewer_controls(lab: Lab) -> str:
    viewer = lab.keys("viewer")
    return answers([a for what in (CONTROL.name, "*", "**") for a in query(viewer, what)])


@attempt("an operator controls", "obeyed")
def operator_controls(lab: Lab) -> str:
    return answers(query(lab.keys("operator"), CONTROL.name))


@attempt("a viewer answers control in place of the service", "obeyed")
def viewer_answers(lab: Lab) -> str:
    def answer(request: zenoh.Query) -> None:
        with request:
            request.reply(f"ldo/{ROBOT}/{CONTROL.name}", b"a lie")

    with open_session(lab.keys("viewer")) as session:
        session.declare_queryable(f"ldo/{ROBOT}/{CONTROL.name}", direct(answer))
        return answers(query(lab.keys("operator"), CONTROL.name))


@attempt("a camera declares the liveliness token of an actor", "not seen")
def camera_is_alive(lab: Lab) -> str:
    token = f"ldo/{ROBOT}/{ALIVE}/mapper"
    lab.got.clear()
    with open_session(lab.keys("camera")) as session, open_session(lab.keys("viewer")) as viewer:
        declared = session.liveliness().declare_token(token)
        session.put(f"ldo/{ROBOT}/{CAMERA_RGBD.name}", b"after it")
        eventually(lambda: bool(lab.got))
        found = list(viewer.liveliness().get(token, timeout=60.0))
        declared.undeclare()
        return "seen" if found else "not seen"


def answers(found: list[bytes]) -> str:
    return ", ".join(sorted({body.decode() for body in found})) or NO_ANSWER


# --- load -----------------------------------------------------------------------------------------
@attempt(f"a camera puts {2 * MAX_MB} MB where {MAX_MB} MB is the limit", "the next arrives")
def oversized(lab: Lab) -> str:
    lab.got.clear()
    with open_session(lab.keys("camera")) as session:
        session.put(f"ldo/{ROBOT}/{CAMERA_RGBD.name}", bytes(2_000_000 * MAX_MB))

        def next_has_come() -> bool:
            session.put(f"ldo/{ROBOT}/{CAMERA_RGBD.name}", b"small")
            return bool(lab.got)

        eventually(next_has_come)
    sizes = {size for _, size in lab.got}
    return "the next arrives" if sizes == {5} else f"sizes {sorted(sizes)} arrive"


@attempt(
    f"a client puts {FLOOD} messages at once on an input that keeps 4", "4 queued, others counted"
)
def flood(lab: Lab) -> str:
    """Count the arriving messages with a second subscriber on the same session."""
    return asyncio.run(_flooded(lab))


async def _flooded(lab: Lab) -> str:
    arrived, busy = [], threading.Event()
    topic = fake_actors.NUMBERS.name
    transport = ZenohTransport(lab.session, lab.network)
    transport.subscribe(topic, lambda _header, body: arrived.append(len(body)))
    stage = fake_actors.collector(transport, [], lambda _value: busy.wait(0.5), policy=Latest(4))

    def put_all() -> None:
        with open_session(lab.keys("service")) as session:
            for value in range(FLOOD):
                session.put(f"ldo/{ROBOT}/{topic}", encode(fake_actors.number(value)))

    async with fake_actors.running(stage):
        await asyncio.to_thread(put_all)
        await fake_actors.eventually(lambda: len(arrived) > 100 and _is_quiet(arrived))
        busy.set()
        await fake_actors.eventually(lambda: _accounted(stage) == len(arrived))
        peak = stage.health().inputs[0].peak_queued
    transport.close()
    return f"{peak} queued, others counted"


def _accounted(stage: fake_actors.Stage) -> int:
    taken = stage.health().inputs[0]
    return taken.delivered + taken.dropped + taken.rejected


def _is_quiet(arrived: list[int]) -> bool:
    count = len(arrived)
    threading.Event().wait(0.2)
    return len(arrived) == count
