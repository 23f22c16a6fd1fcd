"""Accuracy of the live service's map beside the offline run of the same frames.

    python -m tests.bench.bench_live_map [--source synthetic:flat] [--stride 2] [--hz 1 2]
                                         [--max-frames N] [--set SETTING ...] [--out DIR]
                                         [--no-offline]

Each live run starts the service over Zenoh and sends the frames at a fixed rate. Every fifth frame
is held out. When the last frame is sent, the camera stands still, and the run waits until no
message and no refinement is pending. A subscriber of all topics writes the folder of the run, which
`ldo eval` compares with the truth, as the folder of `ldo run`.

The backlog of the mapper is the number of keyframes that wait. It is flat if its mean in the last
quarter of the walk exceeds that in the second quarter by at most one.
"""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import msgspec
import numpy as np
import zenoh

from ldo_service.actors.topology import GRAPH
from ldo_service.client import Client
from ldo_service.config import actor_parameters, config_yaml, load_config
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.runs.folder import RunWriter
from ldo_service.schemas import Health, Keyframe, MapObjects, TrackedPose, decode
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.zenoh_transport import open_session
from tests.bench.bench_backends import Monitor, connect_patiently, wait_until_settled
from tests.ports import free_endpoint

HOLD_OUT = "tracker.hold_out=5"


class Observer:
    """Subscriber of all topics that writes the folder of a run.

    A thread of its own writes, because Zenoh drops messages to a subscriber whose callbacks are
    slow.
    """

    def __init__(self, session: zenoh.Session, network: Endpoint, writer: RunWriter) -> None:
        self._writer = writer
        self._waiting: SimpleQueue[tuple[float, type[Any], bytes] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()
        self.arrived_s: dict[int, float] = {}  # Arrival of the pose of each frame.
        self._keyframes: set[int] = set()
        topics = [out.topic for box in GRAPH for out in box.outputs]
        self._subscribers = [
            session.declare_subscriber(
                network.expression(topic.name),
                zenoh.handlers.Callback(self._taker(topic.message), indirect=False),
            )
            for topic in topics
        ]

    def _known(self, message: MapObjects) -> MapObjects:
        """Return the objects that were first seen in a keyframe that arrived here."""
        arrived = self._keyframes
        objects = tuple(one for one in message.objects if one.first_keyframe in arrived)
        return msgspec.structs.replace(message, objects=objects)

    def _taker(self, kind: type[Any]):
        return lambda sample: self._waiting.put((time.monotonic(), kind, sample.payload.to_bytes()))

    def _write(self) -> None:
        while (arrived := self._waiting.get()) is not None:
            at_s, kind, payload = arrived
            message = decode(payload, kind)
            if isinstance(message, TrackedPose):
                self.arrived_s[message.frame] = at_s
            if isinstance(message, Keyframe):
                self._keyframes.add(message.keyframe)
            if isinstance(message, MapObjects):
                message = self._known(message)
            self._writer.observe(message, 0.0)

    def close(self) -> None:
        """Write all messages that have arrived."""
        self._waiting.put(None)
        self._thread.join()


def live(
    folder: Path, sequence: Sequence, indices: range, hz: float, settings: list[str]
) -> dict[str, Any]:
    """Run the service once, write the folder of the run, and return its measurements."""
    network = Endpoint("robot", free_endpoint())
    words = [word for setting in settings for word in ("--set", setting)]
    config = load_config(None, settings)
    folder.mkdir()
    writer = RunWriter(folder, config_yaml(config), actor_parameters(config).tracker)
    with ExitStack() as stack:
        log = stack.enter_context(tempfile.NamedTemporaryFile())
        service = subprocess.Popen(
            [sys.executable, "-m", "ldo_service", "serve", "--endpoint", network.endpoint, *words],
            stderr=log,
        )
        stack.callback(service.kill)
        client = connect_patiently(stack, network, service, Path(log.name))
        session = stack.enter_context(open_session(network))
        monitor, observer = Monitor(session, network), Observer(session, network, writer)
        assert client.wait_for_subscriber(60)
        sent_s, waiting = send(client, monitor, sequence, indices, hz)
        pending_s = wait_until_settled(monitor)
        poses = [status for _, status in monitor.poses]
        service.send_signal(signal.SIGINT)
        if service.wait(300) != 0:
            raise SystemExit(Path(log.name).read_text()[-3000:])
        time.sleep(1.0)  # The last messages may still be on their way.
        observer.close()
        metrics = monitor.health["mapper"].metrics
    writer.close({"labeller_requests": writer.labeller_calls, "status": writer.statuses})
    ages_ms = [
        1e3 * (observer.arrived_s[i] - at) for i, at in sent_s.items() if i in observer.arrived_s
    ]
    quarter = max(1, len(waiting) // 4)
    return {
        "poses": len(poses),
        "ok": poses.count("OK"),
        "keyframes": writer.keyframes,
        "keyframes_mapped": metrics["keyframes"],
        "age_ms_p50": float(np.percentile(ages_ms, 50)),
        "age_ms_p95": float(np.percentile(ages_ms, 95)),
        "waiting_second_quarter": float(np.mean(waiting[quarter : 2 * quarter])),
        "waiting_last_quarter": float(np.mean(waiting[-quarter:])),
        "refined_after_s": monitor.refined_s,
        "settled_after_s": pending_s,
        "iterations": metrics.get("iterations", 0),
        "objects": len(writer.objects()),
    }


def send(
    client: Client, monitor: Monitor, sequence: Sequence, indices: range, hz: float
) -> tuple[dict[int, float], list[int]]:
    """Send frames at a rate; return when each was sent, and the mapper's backlog at each."""
    sent_s: dict[int, float] = {}
    waiting: list[int] = []
    due_s = time.monotonic()
    for index in indices:
        message = raw_frame_to_message(sequence.read(index), compress_depth=True)
        time.sleep(max(0.0, due_s - time.monotonic()))
        due_s += 1.0 / hz
        client.send(message)
        sent_s[index] = time.monotonic()
        waiting.append(mapper_backlog(monitor.health.get("mapper")))
    return sent_s, waiting


def mapper_backlog(health: Health | None) -> int:
    return sum(i.queued for i in health.inputs if i.topic == "keyframe/new") if health else 0


def offline(folder: Path, options: argparse.Namespace, settings: list[str]) -> dict[str, Any]:
    words = [word for setting in settings for word in ("--set", setting)]
    frames = [] if options.max_frames is None else ["--max-frames", str(options.max_frames)]
    subprocess.run(
        [sys.executable, "-m", "ldo_service", "run", options.source, "--out", folder,
         "--stride", str(options.stride), *frames, *words],
        check=True, capture_output=True,
    )  # fmt: skip
    summary = json.loads((folder / "summary.json").read_text())
    ok = summary["status"]["OK"]
    return {"poses": sum(summary["status"].values()), "ok": ok, "keyframes": summary["keyframes"],
            "iterations": summary["iterations"], "objects": summary["objects"]}  # fmt: skip


def evaluate(folder: Path, source: str) -> dict[str, Any]:
    """Return the results of `ldo eval` on the folder of a run."""
    program = [sys.executable, "-m", "ldo_service", "eval", folder, source, "--json"]
    done = subprocess.run(program, check=True, capture_output=True, text=True)
    return json.loads(done.stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--source", default="synthetic:flat")
    parser.add_argument("--stride", type=int, default=2)
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--hz", type=float, nargs="*", default=[1.0])
    parser.add_argument("--set", nargs="+", dest="settings",
                        default=["detector.model=demo", "vlm_labeller.model=demo"])  # fmt: skip
    parser.add_argument("--out", type=Path, help="folder for the runs; default: a temporary one")
    parser.add_argument("--no-offline", action="store_true")
    options = parser.parse_args()
    settings = [HOLD_OUT, *options.settings]
    sequence = open_sequence(options.source)
    indices = range(0, len(sequence), options.stride)[: options.max_frames]
    options.out = options.out or Path(tempfile.mkdtemp())
    options.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {}
    if not options.no_offline:
        results["offline"] = offline(options.out / "offline", options, settings)
    for hz in options.hz:
        name = f"live-{hz:g}Hz"
        results[name] = live(options.out / name, sequence, indices, hz, settings)
    for name, result in results.items():
        result["scores"] = evaluate(options.out / name, options.source)
        print(name, json.dumps({k: v for k, v in result.items() if k != "scores"}), flush=True)
    (options.out / "results.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
