"""Programs that show faults of earlier versions; each says SEEN if the fault occurs.

    .venv/bin/python -m tests.faults.reproductions
    .venv/bin/python -m tests.faults.reproductions far_depth

The programs also run at commit 18f9264, in an environment that has the package of that commit.
`earlier_names` has the names that were different then.

    git worktree add ../old 18f9264 && python3 -m venv ../old/.venv
    ../old/.venv/bin/pip install ../old && ../old/.venv/bin/python tests/faults/reproductions.py
"""

import asyncio
import logging
import random
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import numpy as np

if not __package__:  # The folder comes last, because the installed package may be the old one.
    sys.path.append(str(Path(__file__).resolve().parents[2]))

from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.mapper import Mapper
from ldo_service.actors.tracker import Tracker
from ldo_service.datasets import open_sequence
from ldo_service.errors import LdoError
from ldo_service.runtime import Actor, In, Latest, Lossless, Out
from ldo_service.runtime.mailbox import Mailbox
from ldo_service.runtime.process import ChildProcess
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.supervision import supervise
from ldo_service.schemas import CameraColor, CameraRgbd, decode
from ldo_service.schemas.topics import (
    CAMERA_RGBD,
    FRAME_RGBD,
    LABEL_ADD,
    MAP_REFINE,
    ODOMETRY_PRIOR,
)
from tests.faults.earlier_names import IS_OLD, found, name, run
from tests.ports import free_port

ROOT = Path(__file__).resolve().parents[2]
encode = msgspec.msgpack.encode
WAIT_S = 20.0  # Time within which a service without the fault is expected to continue.
AddLabel, RefineMap = found("AddLabel"), found("RefineMap")


def add_label(text: str, stamp_ns: int) -> bytes:
    return encode({"type": name("AddLabel"), "stamp_ns": stamp_ns, "name": text})


def header(seq: int, source: str = "outside", epoch: int = 1) -> bytes:
    return encode([source, epoch, seq, 0])


# --- stages -----------------------------------------------------------------------------------
class Counter(Actor):
    """Actor that counts messages, and fails at some messages and after some saves."""

    name = "counter"
    inputs = (In(LABEL_ADD, Latest(32)),)
    fails_after_saving: list[int]  # Counts after whose save an error occurs, once each.
    folder: Path | None  # Folder of the saved state, which the message "damage" truncates.

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def handle(self, message: Any) -> Iterator[Any]:
        if message.name == "damage":
            assert self.folder is not None
            for part in self.folder.rglob("n.*"):
                part.write_bytes(part.read_bytes()[:-1])
        if message.name in ("bad", "damage"):
            raise RuntimeError("cannot be handled")
        self.count += 1
        return iter(())

    def snapshot(self) -> dict[str, Any]:
        return {"n": [self.count]}

    def restore(self, state: Any) -> None:
        self.count = state["n"][0]


def _fail_after_saving(self: Counter) -> None:
    if self.count in self.fails_after_saving:
        self.fails_after_saving.remove(self.count)
        raise RuntimeError("an error after the save")


setattr(Counter, name("on_saved"), _fail_after_saving)


async def counted(
    texts: Sequence[str], folder: Path, fails_after_saving: Sequence[int] = ()
) -> tuple[str, int, bool]:
    """Send messages to a stage with a `Counter`.

    Returns:
        State of the actor, its count, and whether the stage ended.
    """
    Counter.fails_after_saving, Counter.folder = list(fails_after_saving), folder
    transport = found("MemoryTransport")()
    config = found("SupervisionConfig")(heartbeat_s=0.05)
    stage = Stage(Counter, transport, store=found("FolderStore")(folder), config=config)
    running = asyncio.create_task(stage.run())
    until_s = time.monotonic() + WAIT_S
    while stage.health().state == "starting" and time.monotonic() < until_s:
        await asyncio.sleep(0.05)
    for number, text in enumerate(texts):
        transport.deliver(LABEL_ADD.name, header(number), add_label(text, number + 1))
    while not running.done() and time.monotonic() < until_s:
        await asyncio.sleep(0.1)
        health = stage.health()
        if health.steps + getattr(health, name("dead_lettered")) >= len(texts):
            break
    ended = running.done()
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    actor: Any = stage._actor
    return stage.health().state, actor.count, ended


def three_bad_messages() -> bool:
    """Three messages that fail twice within a minute end the service."""
    with tempfile.TemporaryDirectory() as folder:
        texts = ["bad", "good", "bad", "good", "bad", "good"]
        return asyncio.run(counted(texts, Path(folder)))[2]


def error_after_save() -> bool:
    """An error after the save of a step repeats the step, so three messages count as four."""
    with tempfile.TemporaryDirectory() as folder:
        return asyncio.run(counted(["good"] * 3, Path(folder), [2]))[1] != 3


def damaged_state() -> bool:
    """An actor with a damaged state continues empty after an exception, and reports ready."""
    with tempfile.TemporaryDirectory() as folder:
        state, count, ended = asyncio.run(counted(["good"] * 5 + ["damage"], Path(folder)))
        return state == "ready" and count == 0 and not ended


def foreign_sequence_numbers() -> bool:
    """Ten empty messages with sequence numbers 0 and 2^62-1 end a stage."""

    async def run() -> bool:
        transport = found("MemoryTransport")()
        stage = Stage(Counter, transport, config=found("SupervisionConfig")(heartbeat_s=0.05))
        running = asyncio.create_task(stage.run())
        await asyncio.sleep(0.3)
        for epoch in range(1, 6):
            for seq in (0, 2**62 - 1):
                transport.deliver(LABEL_ADD.name, header(seq, epoch=epoch), b"")
        done, _ = await asyncio.wait({running}, timeout=2.0)  # 40 heartbeats.
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        return bool(done)

    Counter.fails_after_saving = []
    return asyncio.run(run())


class Producer(Actor):
    """Actor that makes a message for each one, with the stamp as its number of iterations."""

    name = "producer"
    inputs = (In(LABEL_ADD, Latest(32)),)
    outputs = (Out(MAP_REFINE),)

    def handle(self, message: Any) -> Iterator[Any]:
        rates = {name("initial_rate"): 1.0, name("final_rate"): 1.0}
        stamp_ns = message.stamp_ns
        yield RefineMap(stamp_ns=stamp_ns, iterations=stamp_ns, **rates)


class Consumer(Actor):
    """Actor that counts the messages of the producer."""

    name = "consumer"
    inputs = (In(MAP_REFINE, Lossless(2)),)
    handled = 0

    def handle(self, message: Any) -> Iterator[Any]:  # noqa: ARG002
        Consumer.handled += 1
        return iter(())


def eviction() -> bool:
    """A loss until the eviction of an idle consumer leaves a link that never continues."""

    async def run() -> bool:
        is_losing = False
        Consumer.handled = 0
        transport = found("MemoryTransport")(lose=lambda key: is_losing and "map/refine" in key)
        config = found("SupervisionConfig")(heartbeat_s=0.05, evict_after_s=1.0)
        stages = [
            Stage(
                Producer,
                transport,
                config=config,
                expected={MAP_REFINE.name: frozenset({"consumer"})},
            ),
            Stage(Consumer, transport, config=config),
        ]
        tasks = [asyncio.create_task(stage.run()) for stage in stages]
        await asyncio.sleep(0.3)
        for number in range(8):
            if number == 3:
                await asyncio.sleep(0.5)
                is_losing = True
            transport.deliver(LABEL_ADD.name, header(number), add_label("one", number + 1))
        until_s = time.monotonic() + WAIT_S
        evicted = name("evicted_consumers")
        while time.monotonic() < until_s:
            if getattr(stages[0].health().outputs[0], evicted):
                break
            await asyncio.sleep(0.05)
        await asyncio.sleep(1.0)
        is_losing = False
        while Consumer.handled < 8 and time.monotonic() < until_s:
            await asyncio.sleep(0.05)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        return Consumer.handled < 8

    return asyncio.run(run())


async def deliveries(folder: Path, how: str) -> list[int]:
    """Send messages 1 to 5 to an actor in a process of its own, which message 3 ends.

    Args:
        folder: Folder of the state of the actor.
        how: What message 3 does: crash or hang.

    Returns:
        The numbers of the messages in the order of their deliveries, when the service has ended or
        all messages were delivered.
    """
    network = found("Endpoint")("robot", f"tcp/127.0.0.1:{free_port()}")
    stop, path = found("StopRequest")(), folder / "handled"
    with found("open_session")(network, router=True) as session:
        transport = found("ZenohTransport")(session, network)
        consumers = {MAP_REFINE.name: frozenset({"consumer"})}
        producer = Stage(Producer, transport, expected=consumers)
        program = Path(__file__).with_name("poison_consumer.py")
        command = [sys.executable, str(program), network.endpoint, str(folder), "3", how]
        consumer = ChildProcess("consumer", command, transport)
        service = asyncio.create_task(supervise([producer, consumer], stop, 2.0))
        put, until_s = transport.publisher(LABEL_ADD.name), time.monotonic() + 6 * WAIT_S
        while producer.health().state == "starting" and time.monotonic() < until_s:
            await asyncio.sleep(0.1)
        await asyncio.sleep(1.0)
        for number in range(5):
            await put.send(b"", add_label(str(number), number + 1))
        numbers: list[int] = []
        while not service.done() and 5 not in numbers and time.monotonic() < until_s:
            await asyncio.sleep(0.1)
            numbers = list(map(int, path.read_text().split())) if path.exists() else []
        getattr(stop, name("request"))()
        await asyncio.gather(service, return_exceptions=True)
        transport.close()
    return list(map(int, path.read_text().split()))


def poisoned(how: str) -> bool:
    with tempfile.TemporaryDirectory() as folder:
        numbers = asyncio.run(deliveries(Path(folder), how))
    print(f"deliveries of the message: {numbers.count(3)}, of the next one: {numbers.count(4)}")
    if 1 not in numbers:
        raise RuntimeError(f"the messages did not arrive: {numbers}")
    return numbers.count(3) > 3 and 5 not in numbers


def crashing_message() -> bool:
    """A message that crashes the process of its actor is delivered again until the service ends."""
    return poisoned("crash")


def hanging_message() -> bool:
    """A message that hangs is delivered again until the service ends."""
    return poisoned("hang")


class SlowRunner:
    """Runner that does not end by itself."""

    def __init__(self, number: int) -> None:
        self.name = f"slow {number}"

    async def run(self) -> None:
        await asyncio.Event().wait()

    def drain(self) -> None: ...

    def health(self) -> None: ...


def slow_stop() -> bool:
    """A stop while seven actors do not finish takes seven times `shutdown_timeout_s`."""

    async def stop_s() -> float:
        stop = found("StopRequest")()
        runners = [SlowRunner(number) for number in range(7)]
        service = asyncio.create_task(supervise(runners, stop, 1.0))
        await asyncio.sleep(0.1)
        began_s = time.monotonic()
        getattr(stop, name("request"))()
        await asyncio.gather(service, return_exceptions=True)
        return time.monotonic() - began_s

    took_s = asyncio.run(stop_s())
    print(f"{took_s:.1f} s with a timeout of 1 s for each actor")
    return took_s > 6.0


# --- mailboxes --------------------------------------------------------------------------------
def queued_bytes() -> bool:
    """80 messages of 4 MB on `odometry/prior` wait with more than 200 MB."""

    async def run() -> float:
        transport = found("MemoryTransport")()
        mailbox = Mailbox("tracker", (In(ODOMETRY_PRIOR, Latest(64)),), transport)
        for number in range(80):
            transport.deliver(ODOMETRY_PRIOR.name, header(number), bytes(4_000_000))
        return sum(delivery.body.nbytes for delivery in mailbox._order) / 1e6

    return asyncio.run(run()) > 200.0


def long_header() -> bool:
    """A header with a name of 8 MB is kept."""

    async def run() -> int:
        transport = found("MemoryTransport")()
        mailbox = Mailbox("frame_source", (In(CAMERA_RGBD, Latest(4)),), transport)
        transport.deliver(CAMERA_RGBD.name, header(0, "x" * 8_000_000), b"")
        return len(mailbox._order)

    return asyncio.run(run()) > 0


def unpaired_images() -> bool:
    """Color images without depth wait with more than 64 MB."""
    source, side = FrameSource(), 2000
    camera = {"width": side, "height": side, "cx": 1000.0, "cy": 1000.0, "fx": 1e3, "fy": 1e3}
    pixels = bytes(3 * side * side)
    image = {"encoding": "rgb8", "width": side, "height": side, "data": pixels}
    for number in range(10):
        body = encode(
            {
                "type": "CameraColor",
                "stamp_ns": number * 10**9,
                "frame": number,
                "camera": camera,
                "image": image,
            }
        )
        list(source.handle(decode(body, CameraColor)))
    return len(source._pairing._a.waiting) * len(pixels) > 64e6


# --- cameras and odometry ---------------------------------------------------------------------
def camera_of(frame: Any) -> dict[str, Any]:
    camera = frame.camera
    return {
        "width": camera.width // 2,
        "height": camera.height // 2,
        **{key: getattr(camera, key) / 2 for key in ("fx", "fy", "cx", "cy")},
    }


def image_of(encoding: str, pixels: np.ndarray) -> dict[str, Any]:
    height, width = pixels.shape[:2]
    return {"encoding": encoding, "width": width, "height": height, "data": pixels.tobytes()}


def frames(count: int, stride: int) -> Iterator[dict[str, Any]]:
    """Yield frames of the built-in room with half the width and height, as decoded messages."""
    room = open_sequence("synthetic:room")
    for number in range(count):
        frame: Any = room.read(number * stride % len(room))
        depth_m = np.asarray(frame.depth[::2, ::2], np.float32) / np.float32(frame.depth_scale)
        yield {
            "type": "CameraRgbd",
            "stamp_ns": 10**9 + number * 10**8,
            "frame": number,
            "camera": camera_of(frame),
            "color": image_of("rgb8", np.ascontiguousarray(frame.color[::2, ::2])),
            "depth": image_of("f32", depth_m),
            "depth_scale": 1.0,
        }


async def handled(messages: Sequence[tuple[str, bytes]]) -> int:
    """Send messages to the frame source, the tracker and the mapper, one after the other.

    Returns:
        Number of failed steps, and of stages that ended.
    """
    actors = (FrameSource, Tracker, Mapper)
    transport = found("MemoryTransport")()
    config = found("SupervisionConfig")(heartbeat_s=0.1)
    stages = []
    for actor in actors:
        expected = {
            out.topic.name: frozenset(
                other.name
                for other in actors
                for port in other.inputs
                if port.topic.name == out.topic.name and isinstance(port.policy, Lossless)
            )
            for out in actor.outputs
        }
        stages.append(Stage(actor, transport, config=config, expected=expected))
    tasks = [asyncio.create_task(stage.run()) for stage in stages]
    until_s = time.monotonic() + 3 * WAIT_S
    try:
        while any(s.health().state == "starting" for s in stages) and time.monotonic() < until_s:
            await asyncio.sleep(0.1)
        for topic, body in messages:
            transport.deliver(topic, b"", body)
            if topic != ODOMETRY_PRIOR.name:
                await asyncio.sleep(0.05)
                while is_busy(stages) and time.monotonic() < until_s:
                    await asyncio.sleep(0.02)
        failures = sum(stage.health().failures for stage in stages)
        return failures + sum(task.done() for task in tasks)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def is_busy(stages: Sequence[Stage]) -> bool:
    mailboxes = [stage._mailbox for stage in stages]
    return any(m is None or m._order for m in mailboxes) or any(
        stage.health().state == "busy" for stage in stages
    )


def largest_image() -> bool:
    """An image of the documented maximum size never reaches the tracker."""
    width, megapixels = 4096, documented_megapixels()
    height = int(0.99e6 * megapixels / width)
    size = {"width": width, "height": height}
    camera = size | {"fx": 2e3, "fy": 2e3, "cx": width / 2, "cy": height / 2}
    message = {"type": "CameraRgbd", "stamp_ns": 1, "frame": 0, "depth_scale": 1.0}
    message |= {"camera": camera, "color": image_of("rgb8", np.zeros((height, width, 3), np.uint8))}
    message |= {"depth": image_of("f32", np.ones((height, width), np.float32))}
    (frame,) = FrameSource().handle(decode(encode(message), CameraRgbd))
    body = encode(frame)

    async def run() -> int:
        transport = found("MemoryTransport")()
        mailbox = Mailbox("tracker", Tracker.inputs, transport)
        transport.deliver(FRAME_RGBD.name, header(0, "frame_source"), body)
        return len(mailbox._order)

    waiting = asyncio.run(run())
    print(f"{megapixels} megapixels, {len(body) / 1e6:.0f} MB, waiting for the tracker: {waiting}")
    return waiting == 0


def documented_megapixels() -> float:
    """Return the maximum size of an image in the documentation of the installed package."""
    page = "docs/limits.md"
    text = (ROOT / page).read_text()
    if IS_OLD:
        command = ["git", "show", f"18f9264:{page}"]
        text = subprocess.check_output(command, cwd=ROOT, text=True)
    found_size = re.search(r"\| an image \| ([\d.]+) megapixels", text)
    assert found_size
    return float(found_size[1])


def alternating_clocks() -> bool:
    """200 frames of two clocks in turn write a line into the log for each change back."""
    lines: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: lines.append(record.getMessage())
    log, source, (frame,) = logging.getLogger("ldo_service"), FrameSource(), frames(1, 1)
    logging.disable(logging.NOTSET)
    log.addHandler(handler)
    try:
        for number in range(200):
            stamp_ns = 10**10 * (1 + number % 2) + number
            message = frame | {"frame": number, "stamp_ns": stamp_ns}
            list(source.handle(decode(encode(message), CameraRgbd)))
    finally:
        log.removeHandler(handler)
    count = sum("went back" in line for line in lines)
    print(f"{count} lines")
    return count > 50


def principal_point() -> bool:
    """A camera whose principal point is just inside its limit makes the tracker fail."""
    messages = []
    for frame in frames(4, 6):
        frame["camera"]["cx"] = 1.0 - frame["camera"]["width"]
        messages.append((CAMERA_RGBD.name, encode(frame)))
    return asyncio.run(handled(messages)) > 0


def far_depth() -> bool:
    """The largest float32 where a camera measured nothing makes the mapper fail."""
    messages = []
    for frame in frames(8, 6):
        depth = frame["depth"]
        depth_m = np.frombuffer(depth["data"], np.float32).reshape(depth["height"], -1).copy()
        depth_m[: depth["height"] // 4] = np.finfo(np.float32).max
        messages.append((CAMERA_RGBD.name, encode(frame | {"depth": image_of("f32", depth_m)})))
    return asyncio.run(handled(messages)) > 0


def far_prior() -> bool:
    """Poses of another odometry at 1e100 m make the tracker fail."""
    messages, stamp_ns, turn = [], 950_000_000, 0
    for frame in frames(16, 8):
        # The rounding errors of the poses cancel at other stamps or coordinates.
        frame["stamp_ns"] += 66_000_000
        while stamp_ns < frame["stamp_ns"] + 400_000_000:
            quaternion = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))[turn % 2]
            pose = {"translation": (1.1e100, -0.7e100, 1.3e100), "quaternion": quaternion}
            prior = {"type": "OdometryPrior", "stamp_ns": stamp_ns, name("T_prior_base"): pose}
            messages.append((ODOMETRY_PRIOR.name, encode(prior)))
            stamp_ns, turn = stamp_ns + 200_000_000, turn + 1
        messages.append((CAMERA_RGBD.name, encode(frame)))
    return asyncio.run(handled(messages)) > 0


# --- other inputs -----------------------------------------------------------------------------
def idle_connections() -> bool:
    """Each of 100 idle connections to the metrics server has a thread."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with ExitStack() as stack:
        stack.enter_context(found("serve_metrics")(found("HealthCollector")("robot"), port))
        before = threading.active_count()
        for _ in range(100):
            one = socket.create_connection(("127.0.0.1", port), timeout=10)
            stack.callback(one.close)
            time.sleep(0.02)  # The server has a queue of five connections.
        time.sleep(2.0)
        return threading.active_count() - before >= 100


def silent_addresses() -> bool:
    """A labeller whose name has six silent addresses takes six timeouts for one request."""
    with ExitStack() as stack:
        server = stack.enter_context(socket.socket())
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        for _ in range(4):  # The queue of the server is full, so further connections wait.
            one = stack.enter_context(socket.socket())
            one.setblocking(False)
            one.connect_ex(server.getsockname())
        address = (socket.AF_INET, socket.SOCK_STREAM, 6, "", server.getsockname())
        stack.enter_context(mock.patch("socket.getaddrinfo", return_value=[address] * 6))
        config = found("HttpClientConfig")(timeout_s=1.0, patience_s=2.0)
        url = f"http://labeller.test:{server.getsockname()[1]}/v1"
        client, begun_s = found("HttpClient")(url, config), time.monotonic()
        with suppress(LdoError):
            client.post("/chat/completions", b"{}", begun_s + 2.0)
        return time.monotonic() - begun_s > 5.0


def flipped_bits() -> bool:
    """A state with a flipped bit is loaded."""
    chance, loaded = random.Random(1), 0
    store = found("FolderStore")
    for _ in range(30):
        with tempfile.TemporaryDirectory() as folder:
            state = {"rows": np.arange(2000.0), "count": [3, 4]}
            store(Path(folder)).save("counter", state)
            file = chance.choice([path for path in Path(folder).rglob("*.*") if path.is_file()])
            body = bytearray(file.read_bytes())
            body[chance.randrange(len(body))] ^= 1 << chance.randrange(8)
            file.write_bytes(body)
            with suppress(LdoError):
                loaded += store(Path(folder)).load("counter") is not None
    return loaded > 0


def used_port() -> bool:
    """A start on a used port has exit code 2, as for a typing error."""
    with socket.socket() as used, tempfile.TemporaryDirectory() as folder:
        used.bind(("127.0.0.1", 0))
        used.listen()
        endpoint = f"tcp/127.0.0.1:{used.getsockname()[1]}"
        command = [sys.executable, "-m", "ldo_service", "serve", "--endpoint", endpoint]
        result = subprocess.run([*command, "--state", folder], capture_output=True, timeout=60)
        return result.returncode == 2


PROGRAMS: dict[str, Callable[[], bool]] = {
    program.__name__: program
    for program in (
        foreign_sequence_numbers,
        three_bad_messages,
        error_after_save,
        crashing_message,
        hanging_message,
        slow_stop,
        damaged_state,
        eviction,
        queued_bytes,
        long_header,
        unpaired_images,
        largest_image,
        alternating_clocks,
        principal_point,
        far_depth,
        far_prior,
        idle_connections,
        silent_addresses,
        flipped_bits,
        used_port,
    )
}


if __name__ == "__main__":
    run(PROGRAMS, __file__)
