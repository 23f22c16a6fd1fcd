"""A walk that closes a loop, live: closure, correction, moved map and named object.

The subscriber is a program with zenoh and msgpack alone, as another language would have it.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import open_sequence
from tests.service.conftest import LDO, LiveService, live_service, metric, wait_until

from .test_live import EVERY_ACTOR

pytestmark = pytest.mark.slow

# The camera waits while the mapper is farther behind: a slow machine would make fewer keyframes.
MAX_KEYFRAMES_BEHIND = 3
RATE_HZ = 4.0

# Program that prints a line of JSON for each kind of result when it first sees it.
SUBSCRIBER = """
import json, signal, sys, zenoh, msgpack
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
seen = set()
def show(kind, value):
    if value and kind not in seen:
        seen.add(kind)
        print(json.dumps({kind: value}), flush=True)
def take(sample):
    message = msgpack.unpackb(sample.payload.to_bytes())
    if message["type"] == "LoopClosure":
        show("closure", [message["pose"]["reference"], message["pose"]["keyframe"]])
    elif message["type"] == "GraphCorrection":
        show("accepted", message["accepted_closures"])
    elif message["type"] == "MapDelta" and "accepted" in seen:
        show("moved", [motion["keyframe"] for motion in message["motions"]])
    elif message["type"] == "MapObjects":
        show("names", [one["name"] for one in message["objects"]])
topics = "loop/closure", "graph/correction", "map/delta", "map/objects"
with zenoh.open(config) as session:
    kept = [session.declare_subscriber(f"ldo/robot/{topic}", take) for topic in topics]
    print("{}", flush=True)
    signal.pause()
"""


def test_loop_is_closed_while_the_camera_stands_still_and_replays(tmp_path: Path) -> None:
    """The walk ends where it began; its last keyframes are compared before the service stops."""
    recording, output = tmp_path / "recording", tmp_path / "subscriber.jsonl"
    settings = ("detector.model=demo", "vlm_labeller.model=demo", "mapper.iterations=4")
    options = [word for setting in settings for word in ("--set", setting)]

    def shown() -> dict[str, list]:
        lines = output.read_text().splitlines()
        return {kind: value for line in lines for kind, value in json.loads(line).items()}

    with live_service(tmp_path, *options, "--record", str(recording)) as service:
        service.wait_for_actors()
        with output.open("w") as file:
            service.start([sys.executable, "-c", SUBSCRIBER, service.endpoint], stdout=file)
        wait_until(lambda: bool(output.read_text()), 20, "the subscriber is connected")
        walk(service)
        wait_until(
            lambda: shown().keys() >= {"closure", "accepted", "moved", "names"},
            60,
            "closure, correction, moved map and named objects have arrived",
        )
        wait_until(
            lambda: service.update_health()["mapper"].metrics["iterations_pending"] == 0,
            60,
            "the map is refitted while the camera stands still",
        )
        assert service.stop(timeout_s=30) == 0
        assert "Traceback" not in service.log
    assert shown()["closure"] in shown()["accepted"]
    assert all(isinstance(name, str) and name for name in shown()["names"])
    assert {path.stem for path in recording.iterdir()} == set(EVERY_ACTOR)
    replay = subprocess.run(
        [*LDO, "replay", str(recording), "--verify"], capture_output=True, text=True, check=False
    )
    assert replay.returncode == 0, replay.stdout + replay.stderr


def walk(service: LiveService) -> None:
    """Send every third frame of the tour; each has a pose before the next one is sent."""
    frames = open_sequence("synthetic:tour-noisy")
    for index in range(0, len(frames), 3):
        due_s = time.monotonic() + 1 / RATE_HZ
        service.pose_of(raw_frame_to_message(frames.read(index)))
        wait_until(lambda: keyframes_behind(service) <= MAX_KEYFRAMES_BEHIND, 30, "mapped")
        time.sleep(max(0.0, due_s - time.monotonic()))


def keyframes_behind(service: LiveService) -> float:
    """Return the number of keyframes in the last heartbeats that the mapper has not mapped."""
    return metric(service, "tracker", "keyframes") - metric(service, "mapper", "keyframes")
