"""Live service whose back ends run on another host, in network namespaces with a bad network.

The namespaces need root and `ip`; without them the tests are skipped. `tc netem` delays and drops
the packets. If the kernel has no netem, a relay delays the bytes of the TCP connections instead: by
the delay of the network, and for lost packets by a retransmission timeout.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.service.conftest import PATIENCE

pytestmark = pytest.mark.slow

ROBOT, HOST = "ldo-robot", "ldo-host"
ROBOT_ADDRESS, HOST_ADDRESS = "10.213.7.1", "10.213.7.2"
DELAY_S, LOSS = 0.025, 0.05  # Both are for each direction: 50 ms in all.
NETEM = ("delay", f"{1000 * DELAY_S:g}ms", "loss", f"{100 * LOSS:g}%")
RETRANSMISSION_S = 0.2  # Minimum retransmission timeout of TCP on Linux.
REMOTE = ("optimizer", "detector", "vlm_labeller")
SETTINGS = ("detector.model=demo", "vlm_labeller.model=demo", "mapper.threads=1")

# Program that listens at a port and forwards connections to an address, late. Arguments: port,
# address, delay, loss and retransmission timeout.
RELAY = """
import asyncio, random, sys
port, address, (delay_s, loss, late_s) = sys.argv[1], sys.argv[2], map(float, sys.argv[3:])
async def forward(reader, writer):
    queue = asyncio.Queue()
    async def send():
        while True:
            due_s, data = await queue.get()
            await asyncio.sleep(max(0, due_s - asyncio.get_running_loop().time()))
            writer.write(data)
            await writer.drain()
    task = asyncio.ensure_future(send())
    while data := await reader.read(1448):
        lost = late_s * (random.random() < loss)
        queue.put_nowait((asyncio.get_running_loop().time() + delay_s + lost, data))
async def relay(reader, writer):
    host, _, target = address.partition(":")
    far_reader, far_writer = await asyncio.open_connection(host, int(target))
    await asyncio.gather(forward(reader, far_writer), forward(far_reader, writer))
async def main():
    async with await asyncio.start_server(relay, "127.0.0.1", int(port)) as server:
        await server.serve_forever()
asyncio.run(main())
"""

# Program that counts poses, corrections and detections for some seconds, and prints them.
COUNT = """
import json, sys, time, zenoh, msgpack
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
counts = {"OK": 0, "poses": 0, "corrections": 0, "detections": 0, "names": 0}
def take(sample):
    message = msgpack.unpackb(sample.payload.to_bytes())
    kind = message["type"]
    counts["poses"] += kind == "TrackedPose"
    counts["OK"] += message.get("status") == "OK"
    counts["corrections"] += kind == "GraphCorrection"
    counts["detections"] += kind == "DetectionBoxes" and bool(message["network"])
    counts["names"] += kind == "LabelResult" and bool(message["label"])
topics = "pose/tracked", "graph/correction", "detection/boxes", "label/result"
def connect():
    for _ in range(120):
        try:
            return zenoh.open(config)
        except zenoh.ZError:
            time.sleep(0.5)
with connect() as session:
    kept = [session.declare_subscriber(f"ldo/robot/{topic}", take) for topic in topics]
    print("listening", flush=True)
    sys.stdin.readline()
    print(json.dumps(counts), flush=True)
"""


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True)


@pytest.fixture
def has_netem() -> Iterator[bool]:
    """Connect two namespaces, and yield whether the kernel adds delay and loss between them."""
    if os.geteuid() != 0 or not shutil.which("ip"):
        pytest.skip("needs root and ip for network namespaces")
    has_netem = shutil.which("tc") is not None
    with ExitStack() as stack:
        try:
            for name in (ROBOT, HOST):
                run("ip", "netns", "add", name)
                stack.callback(subprocess.run, ["ip", "netns", "del", name], check=False)
            run("ip", "link", "add", "ldo0", "netns", ROBOT, "type", "veth",
                "peer", "name", "ldo1", "netns", HOST)  # fmt: skip
            for name, link, address in (
                (ROBOT, "ldo0", ROBOT_ADDRESS),
                (HOST, "ldo1", HOST_ADDRESS),
            ):
                inside = ("ip", "netns", "exec", name)
                run(*inside, "ip", "address", "add", f"{address}/24", "dev", link)
                run(*inside, "ip", "link", "set", link, "up")
                run(*inside, "ip", "link", "set", "lo", "up")
                netem = ("tc", "qdisc", "add", "dev", link, "root", "netem", *NETEM)
                has_netem = has_netem and subprocess.run((*inside, *netem)).returncode == 0
        except subprocess.CalledProcessError as error:
            pytest.skip(f"network namespaces cannot be made: {error.stderr.decode().strip()}")
        yield has_netem


def test_remote_back_ends_behind_a_bad_network_delay_no_pose(
    has_netem: bool, tmp_path: Path
) -> None:
    endpoint = f"tcp/{ROBOT_ADDRESS}:7447"
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    with ExitStack() as stack:

        def start(name: str, *arguments: str, **options: Any) -> subprocess.Popen[str]:
            process = subprocess.Popen(
                ["ip", "netns", "exec", name, sys.executable, *arguments], text=True, **options
            )
            stack.callback(lambda: (process.kill(), process.wait()))
            return process

        def serve(name: str, log: str, address: str, *arguments: str) -> None:
            file = stack.enter_context((tmp_path / log).open("w"))
            state = ("--state", str(tmp_path / f"state-{log}"))
            program = ("-m", "ldo_service", "serve", "--endpoint", address)
            start(name, *program, *state, *settings, *arguments, stderr=file)

        remote = f"service.remote_actors=[{','.join(REMOTE)}]"
        serve(ROBOT, "robot.log", endpoint, "--insecure", "--set", remote)
        counter = start(ROBOT, "-c", COUNT, endpoint, stdin=-1, stdout=-1)
        assert counter.stdin
        assert counter.stdout
        assert counter.stdout.readline() == "listening\n"
        remote_endpoint = endpoint
        if not has_netem:
            times = map(str, (DELAY_S, LOSS, RETRANSMISSION_S))
            start(HOST, "-c", RELAY, "7447", endpoint.removeprefix("tcp/"), *times)
            remote_endpoint = "tcp/127.0.0.1:7447"
        for actor in REMOTE:
            serve(HOST, f"{actor}.log", remote_endpoint, "--actor", actor, "--client")
        time.sleep(10)  # The remote processes connect.
        camera = start(
            ROBOT, "-m", "ldo_service", "publish", "synthetic:room", "--endpoint", endpoint,
            *("--rate", "4", "--max-frames", "100"), stderr=subprocess.DEVNULL,
        )  # fmt: skip
        assert camera.wait(60 * PATIENCE) == 0
        time.sleep(5)  # The last results arrive.
        counts, _ = counter.communicate("\n", timeout=10 * PATIENCE)
    counted = json.loads(counts)
    # The camera and an outside subscriber may lose a message on a busy machine.
    assert counted["poses"] == counted["OK"] >= 95
    assert counted["corrections"] > 5
    assert counted["detections"] > 5
    assert counted["names"] > 0
