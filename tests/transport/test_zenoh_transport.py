"""Tests of the runtime over Zenoh on the loopback interface."""

import asyncio
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import msgpack
import pytest
import zenoh

from ldo_service.errors import ConfigError
from ldo_service.runtime import Latest
from ldo_service.runtime.actor import Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage
from ldo_service.schemas import Health, decode, encode
from ldo_service.transport.flow_control import Header, data_key, encode_link
from ldo_service.transport.message_reader import MessageReader
from ldo_service.transport.zenoh_transport import (
    MAX_QUERIES,
    Endpoint,
    ZenohTransport,
    open_session,
)
from tests.ports import free_port
from tests.runtime.fake_actors import (
    DOUBLES,
    NUMBERS,
    PIECES,
    QUICK,
    DoubleCollector,
    Doubler,
    Number,
    Piece,
    collector,
    eventually,
    number,
    running,
    send,
)

Client = Callable[[], zenoh.Session]


def outlet(transport: ZenohTransport, *expected: str) -> Outlet:
    return Outlet(Out(NUMBERS), "producer", 1, transport, expected)


async def test_lossless_images_reach_a_slow_consumer_in_order(
    network: Endpoint, client: Client
) -> None:
    seen: list[int] = []
    source = outlet(ZenohTransport(client(), network), "collector")
    stage = collector(ZenohTransport(client(), network), seen, lambda _value: time.sleep(0.01))
    image = bytes(1_000_000)
    async with running(stage):
        for value in range(60):
            await send(source, number(value, data=image))
        await source.flush()
        await eventually(lambda: len(seen) == 60)
        counted = stage.health().inputs[0]
    assert seen == list(range(60))
    assert counted.peak_queued <= 4
    assert counted.dropped == 0


async def test_stages_in_different_sessions_form_a_chain(network: Endpoint, client: Client) -> None:
    seen: list[int] = []
    expected = {DOUBLES.name: frozenset({"double_collector"})}
    one, two, three = (ZenohTransport(client(), network) for _ in range(3))
    numbers = outlet(one, "doubler")
    async with running(
        Stage(Doubler, two, config=QUICK, expected=expected),
        Stage(lambda: DoubleCollector(seen), three, config=QUICK),
    ):
        for value in range(100):
            await send(numbers, number(value))
        await eventually(lambda: len(seen) == 100)
    assert seen == [2 * value for value in range(100)]


async def test_blocked_external_subscriber_does_not_slow_the_others(
    network: Endpoint, client: Client
) -> None:
    release, payload_sizes = threading.Event(), []

    def block(sample: zenoh.Sample) -> None:
        payload_sizes.append(len(sample.payload.to_bytes()))
        release.wait(60)  # This is longer than the rest of the test takes.

    handler = zenoh.handlers.Callback(block, indirect=False)
    client().declare_subscriber(network.expression(NUMBERS.name), handler)
    seen: list[int] = []
    source = outlet(ZenohTransport(client(), network), "collector")
    async with running(collector(ZenohTransport(client(), network), seen)):
        for value in range(30):
            await send(source, number(value, data=bytes(1_000_000)))
        await eventually(lambda: len(seen) == 30)
        assert len(payload_sizes) <= 1
        release.set()
    assert seen == list(range(30))


async def test_late_client_queries_all_parts_of_the_last_value(
    network: Endpoint, client: Client
) -> None:
    transport = ZenohTransport(client(), network)
    pieces = Outlet(Out(PIECES), "me", 1, transport)
    for part in range(3):
        await send(pieces, Piece(stamp_ns=1, version=1, part=part, parts=3))
    requester = client()

    def query_parts() -> list[int]:
        replies = requester.get(
            network.expression(PIECES.name),
            timeout=60.0,
            # Zenoh would otherwise keep only one part of a key.
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        return [msgpack.unpackb(reply.ok.payload.to_bytes())["part"] for reply in replies]

    assert await asyncio.to_thread(query_parts) == [0, 1, 2]


async def test_slow_query_does_not_block_messages(network: Endpoint, client: Client) -> None:
    transport, seen = ZenohTransport(client(), network), []
    query_arrived, release = threading.Event(), threading.Event()

    def slow_values() -> list[tuple[bytes, bytes]]:
        query_arrived.set()
        release.wait(60)
        return [(b"", b"value")]

    transport.serve_queries("test/slow", slow_values)
    requester = client()
    many = range(MAX_QUERIES + 5)
    replies = [requester.get(network.expression("test/slow"), timeout=60.0) for _ in many]
    source = outlet(transport)
    async with running(collector(transport, seen, policy=Latest(8))):
        await eventually(query_arrived.is_set)
        await send(source, number(1))
        await eventually(lambda: seen == [1])
        release.set()
        answers = await asyncio.to_thread(lambda: [next(iter(reply)) for reply in replies])
    assert sum(answer.ok is not None for answer in answers) >= MAX_QUERIES
    assert any(answer.err is not None for answer in answers)
    transport.close()


async def test_slow_queries_do_not_delay_commands(network: Endpoint, client: Client) -> None:
    transport, release = ZenohTransport(client(), network), threading.Event()

    def slow_values() -> list[tuple[bytes, bytes]]:
        release.wait(60)
        return [(b"", b"value")]

    async def obey(request: bytes) -> bytes:
        return request + b" obeyed"

    transport.serve_queries("test/slow", slow_values)
    transport.respond("test/command", obey)
    requester = client()
    many = range(MAX_QUERIES + 5)
    replies = [requester.get(network.expression("test/slow"), timeout=60.0) for _ in many]

    def command() -> bytes:
        command = requester.get(network.expression("test/command"), payload=b"pause", timeout=60.0)
        reply = next(iter(command))
        return reply.ok.payload.to_bytes() if reply.ok is not None else b"rejected"

    answers = await asyncio.to_thread(lambda: [command() for _ in range(5)])
    release.set()
    await asyncio.to_thread(lambda: [next(iter(reply)) for reply in replies])
    assert answers == [b"pause obeyed"] * 5
    transport.close()


async def test_reader_skips_what_other_programs_put_on_a_topic(
    network: Endpoint, client: Client
) -> None:
    reader, writer, got = MessageReader(client(), network), client(), []

    def read_two() -> None:
        for header, _ in reader.messages(NUMBERS, 16):
            got.append(header.seq)
            if len(got) == 2:
                return

    reading = asyncio.create_task(asyncio.to_thread(read_two))
    put, key = writer.put, network.expression(NUMBERS.name)

    def put_all(seq: int) -> None:
        body = encode(number(seq))
        put(key, body)
        put(key, body, attachment=b"\xc1")
        put(key, b"\xc1", attachment=encode_link(Header("x", 1, 2 * seq, 0)))
        put(key, body, attachment=encode_link(Header("x", 1, 2 * seq + 1, 0)))

    for seq in range(1000):
        await asyncio.to_thread(put_all, seq)
        await asyncio.wait({reading}, timeout=0.05)
        if reading.done():
            break
    await reading
    assert len(got) == 2
    assert all(seq % 2 for seq in got)


async def test_liveliness_watcher_sees_present_joining_and_leaving_actors(
    network: Endpoint, client: Client
) -> None:
    seen: list[tuple[str, bool]] = []
    early, watcher = (ZenohTransport(client(), network) for _ in range(2))
    early.declare_liveliness("early")
    watcher.watch_liveliness(lambda name, alive: seen.append((name, alive)))
    await eventually(lambda: ("early", True) in seen)
    session = client()
    late = ZenohTransport(session, network)
    late.declare_liveliness("late")
    await eventually(lambda: ("late", True) in seen)
    session.close()
    await eventually(lambda: ("late", False) in seen)


async def test_foreign_program_decodes_body_and_header_with_msgpack(
    network: Endpoint, client: Client
) -> None:
    samples: list[tuple[dict[str, object], list[object]]] = []

    def store(sample: zenoh.Sample) -> None:
        header = msgpack.unpackb(sample.attachment.to_bytes())
        samples.append((msgpack.unpackb(sample.payload.to_bytes()), header))

    handler = zenoh.handlers.Callback(store, indirect=False)
    client().declare_subscriber(network.expression(NUMBERS.name), handler)
    source = outlet(ZenohTransport(client(), network))

    async def keep_sending() -> None:
        while not samples:
            await send(source, number(7, region="door"))
            await asyncio.sleep(0.01)

    await asyncio.wait_for(keep_sending(), 60)
    body, header = samples[0]
    assert body["value"] == 7
    assert header[:2] == ["producer", 1]
    assert header[3:] == [7, "door"]


async def test_message_of_a_foreign_program_reaches_a_latest_input(
    network: Endpoint, client: Client
) -> None:
    seen: list[int] = []
    stage = collector(ZenohTransport(client(), network), seen, policy=Latest(4))
    foreign = client()
    body = msgpack.packb({"type": "Number", "stamp_ns": 1, "value": 5})

    def put() -> bool:
        foreign.put(network.expression(NUMBERS.name), b"noise", attachment=b"\xff")
        foreign.put(network.expression(NUMBERS.name), body)
        return bool(seen)

    async with running(stage):
        await eventually(put)
        assert stage.health().inputs[0].rejected > 0
    assert set(seen) == {5}


async def test_heartbeats_arrive_over_zenoh(network: Endpoint, client: Client) -> None:
    beats: list[Health] = []
    transport = ZenohTransport(client(), network)
    transport.subscribe("health/doubler", lambda _header, body: beats.append(decode(body, Health)))
    async with running(Stage(Doubler, ZenohTransport(client(), network), config=QUICK)):
        await eventually(lambda: len(beats) >= 3)
    assert beats[0].actor == "doubler"


async def test_newer_post_replaces_an_unsent_one(network: Endpoint, client: Client) -> None:
    publisher = ZenohTransport(client(), network).publisher("test/post")
    received: list[bytes] = []
    receiver = ZenohTransport(client(), network)
    receiver.subscribe("test/post", lambda _header, body: received.append(bytes(body)))

    def post_many() -> bool:
        for value in range(1000):
            publisher.post(b"", str(value).encode())
        return received[-1:] == [b"999"]

    await eventually(post_many)


async def test_closing_twice_or_after_the_session_is_harmless(
    network: Endpoint, client: Client
) -> None:
    session = client()
    transport = ZenohTransport(session, network)
    transport.declare_liveliness("me")
    transport.subscribe("test/number", lambda _header, _body: None)
    publisher = transport.publisher("test/number")
    session.close()
    publisher.close()
    publisher.post(b"", b"late")
    transport.close()
    transport.close()


def test_callbacks_after_the_end_of_the_loop_are_harmless(
    network: Endpoint, client: Client
) -> None:
    session, seen = client(), []

    async def run_briefly() -> None:
        async with running(collector(ZenohTransport(session, network), seen)):
            await asyncio.sleep(0.05)

    asyncio.run(run_briefly())  # The session and its subscriptions stay open.
    arrived = threading.Event()
    handler = zenoh.handlers.Callback(lambda _sample: arrived.set(), indirect=False)
    session.declare_subscriber(network.expression(data_key(NUMBERS.name)), handler)
    other = client()
    while not arrived.wait(0.02):
        for key in ("test/number", "link/welcome/test/number", "link/alive/x"):
            other.put(network.expression(key), encode_link([1, {"collector": 5}]), attachment=b"x")
    assert seen == []


def test_used_port_and_absent_service_are_reported(network: Endpoint) -> None:
    with pytest.raises(ConfigError, match=r"is another `ldo serve` running there\?"):
        open_session(network, router=True)
    absent = Endpoint("test", f"tcp/127.0.0.1:{free_port()}")
    with pytest.raises(ConfigError, match="no service replies on") as failure:
        open_session(absent)
    assert failure.value.__suppress_context__  # One traceback for the user, not two.


@pytest.mark.parametrize("is_router", [False, True])
def test_connection_without_messages_is_closed_before_tcp_waits_long(
    network: Endpoint, is_router: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TCP doubles its waits from 0.2 s on, so the sixth one takes 6.4 s."""
    opened: list[zenoh.Config] = []
    monkeypatch.setattr(zenoh, "open", opened.append)
    open_session(network, router=is_router)
    assert 0 < json.loads(opened[0].get_json("transport/link/tx/lease")) <= 6400


def test_client_tries_to_connect_every_second(
    network: Endpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[zenoh.Config] = []
    monkeypatch.setattr(zenoh, "open", opened.append)
    open_session(network)
    assert json.loads(opened[0].get_json("connect/retry"))["period_max_ms"] == 1000


@pytest.mark.skipif(sys.platform != "linux", reason="/proc exists on Linux only")
async def test_closing_connections_do_not_occupy_all_receiving_threads() -> None:
    """Each closing connection with unsent data blocks a thread for up to 10 s."""
    network = Endpoint("test", f"tcp/127.0.0.1:{free_port()}")
    program = [sys.executable, str(Path(__file__).with_name("router_process.py"))]
    router = subprocess.Popen([*program, network.endpoint], stdout=subprocess.PIPE)
    threads = Path("/proc", str(router.pid), "task")
    try:
        assert router.stdout
        router.stdout.readline()
        with open_session(network):
            await eventually(
                lambda: sum("rx-" in path.read_text() for path in threads.glob("*/comm")) >= 16
            )
    finally:
        router.kill()
        router.communicate()


@pytest.mark.parametrize("robot", ["", "a/b", "*", "a b", "$x", "a?", "#", "@"])
def test_robot_name_invalid_in_topics_is_rejected(robot: str) -> None:
    with pytest.raises(ConfigError, match="robot name"):
        Endpoint(robot)


def test_number_of_the_collector_process_decodes() -> None:
    """The collector process declares its own message type, which must match these bytes."""
    body = msgpack.packb({"type": "Number", "stamp_ns": 1, "value": 5})
    assert decode(body, Number) == Number(stamp_ns=1, value=5)


@pytest.mark.slow
async def test_stopped_router_blocks_no_event_loop_and_loses_nothing() -> None:
    network, seen = Endpoint("test", f"tcp/127.0.0.1:{free_port()}"), []
    program = [sys.executable, str(Path(__file__).with_name("router_process.py"))]
    router = subprocess.Popen([*program, network.endpoint], stdout=subprocess.PIPE)
    try:
        assert router.stdout
        router.stdout.readline()
        with open_session(network) as one, open_session(network) as other:
            source = outlet(ZenohTransport(one, network), "collector")
            async with running(collector(ZenohTransport(other, network), seen)):
                await send_images(source, range(20))
                router.send_signal(signal.SIGSTOP)
                sending = asyncio.create_task(send_images(source, range(20, 60)))
                pauses = [await measure_pause() for _ in range(300)]
                assert not sending.done()
                router.send_signal(signal.SIGCONT)
                await sending
                await eventually(lambda: len(seen) == 60)
        assert seen == list(range(60))
        assert max(pauses) < 1.0  # A blocking put would take seconds.
    finally:
        router.kill()
        router.communicate()


@pytest.mark.slow
def test_stopped_readers_do_not_stop_the_messages_of_other_programs() -> None:
    """The router closes the connections of the readers, each with much unsent data."""
    network = Endpoint("test", f"tcp/127.0.0.1:{free_port()}")
    came_s: list[float] = []
    with ExitStack() as stack:

        def start(name: str, *arguments: str) -> "subprocess.Popen[str]":
            program = [sys.executable, str(Path(__file__).with_name(name)), network.endpoint]
            process = subprocess.Popen([*program, *arguments], stdout=subprocess.PIPE, text=True)
            stack.callback(lambda: (process.kill(), process.communicate()))
            assert process.stdout
            assert process.stdout.readline() == "up\n"
            return process

        start("router_process.py")
        readers = [start("reader_process.py", "large") for _ in range(4)]
        images, numbers, consumer = (stack.enter_context(open_session(network)) for _ in range(3))
        handler = zenoh.handlers.Callback(lambda _: came_s.append(time.monotonic()), indirect=False)
        consumer.declare_subscriber("small", handler)
        for reader in readers:
            reader.send_signal(signal.SIGSTOP)
        until_s = time.monotonic() + 25.0
        while time.monotonic() < until_s:
            images.put("large", bytes(1_000_000))
            numbers.put("small", b"1")
            time.sleep(0.2)
        came_s.append(time.monotonic())
    assert len(came_s) > 1
    # A blocked router would pass on nothing for 10 s.
    assert max(after - before for before, after in pairwise(came_s)) < 5.0


async def send_images(source: Outlet, values: range) -> None:
    for value in values:
        await send(source, number(value, data=bytes(1_000_000)))


async def measure_pause() -> float:
    """Return how long the event loop took for a sleep of 10 ms, in seconds."""
    started_s = time.perf_counter()
    await asyncio.sleep(0.01)
    return time.perf_counter() - started_s
