"""A walk that closes a loop, live: closure, correction, moved map and named object.

The subscriber is a program with zenoh and msgpack alone, as another language would have it.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.conftest import LDO, PATIENCE, live_service, wait_until

pytestmark = pytest.mark.slow

# Program that prints a line of JSON for each kind of result when it first sees it.
SUBSCRIBER = """
import json, sys, zenoh, msgpack
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
    sys.stdin.readline()
"""


def test_loop_is_closed_while_the_camera_stands_still_and_replays(tmp_path: Path) -> None:
    """The walk ends where it began; its last keyframes are compared without a stop."""
    recording, models = tmp_path / "recording", ("detector.model=demo", "vlm_labeller.model=demo")
    settings = [word for setting in models for word in ("--set", setting)]
    shown: dict[str, list] = {}
    with live_service(tmp_path, *settings, "--record", str(recording)) as service:
        service.wait_for_actors()
        program = [sys.executable, "-c", SUBSCRIBER, service.endpoint]
        subscriber = service.start(
            program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert subscriber.stdout
        assert subscriber.stdout.readline() == "{}\n"
        camera = service.publisher("synthetic:tour-noisy", "--stride", "3", "--rate", "4")
        assert camera.wait(60 * PATIENCE) == 0
        while not {"closure", "accepted", "moved", "names"} <= shown.keys():
            line = subscriber.stdout.readline()
            assert line, service.log
            shown |= json.loads(line)
        wait_until(
            lambda: service.update_health()["mapper"].metrics["iterations_pending"] == 0,
            60,
            "the map is refitted while the camera stands still",
        )
        subscriber.communicate("\n", timeout=10 * PATIENCE)
        assert service.stop(timeout_s=30) == 0
        assert "Traceback" not in service.log
    assert shown["closure"] in shown["accepted"]
    assert all(isinstance(name, str) and name for name in shown["names"])
    replay = subprocess.run(
        [*LDO, "replay", str(recording), "--verify"], capture_output=True, text=True, check=False
    )
    assert replay.returncode == 0, replay.stdout + replay.stderr
