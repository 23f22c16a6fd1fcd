"""Cost of an unwatched viewer window for a service with more frames than it can handle.

    python -m tests.bench.bench_viewer [SOURCE] [--pairs N] [--rate HZ] [--frames N]

SOURCE: default tum/kitchen in LDO_DATA, else synthetic:room. Service, camera and viewer run in
processes of their own. Each round starts with an empty map and the same frames, by default faster
than the service can handle them. A pair is a round with the viewer connected, its window open and
no browser, and a round without; the order alternates. The output has CPU time of the service per
handled frame, and CPU time of the viewer. On a busy machine use `--rate 2 --frames 60`: then every
round handles the same frames, and the CPU times are comparable.
"""

import argparse
import multiprocessing
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path

import numpy as np

from ldo_service.client import Client, connect
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import open_sequence
from ldo_service.schemas import TrackedPose
from ldo_service.schemas.topics import POSE_TRACKED
from ldo_service.viewer.live import live
from ldo_service.viewer.view_config import ViewerConfig
from ldo_service.viewer.window import open_window
from tests.service.conftest import LiveService, live_service

TICKS = os.sysconf("SC_CLK_TCK")
DETAILS = 8192  # Poses that the inbox holds until they are counted.
CONFIG = ViewerConfig(port=0)


@dataclass(frozen=True)
class Round:
    poses_hz: float
    cpu_ms: float  # CPU time of the service per handled frame.
    viewer_share: float  # CPU seconds of the viewer per second.


def look(endpoint: str, wanted: Event, is_ready: Event) -> None:
    """Run the viewer's process, connected while `wanted` is set."""
    while wanted.wait():
        with (
            connect("robot", endpoint) as service,
            live(service, CONFIG) as source,
            open_window(source, CONFIG, "bench") as window,
        ):
            is_ready.set()
            while wanted.is_set():
                window.show(source.update(is_watched=window.is_watched))
                time.sleep(CONFIG.update_s)
        is_ready.clear()


@dataclass(frozen=True)
class Frames:
    source: str
    count: int
    rate_hz: float


def send(endpoint: str, frames: Frames, wanted: Event) -> None:
    """Run the camera's process, which sends all frames once each time `wanted` is set."""
    sequence = open_sequence(frames.source)
    messages = [raw_frame_to_message(sequence.read(index)) for index in range(frames.count)]
    with connect("robot", endpoint) as service:
        while wanted.wait():
            started_s = time.monotonic()
            for number, message in enumerate(messages):
                time.sleep(max(0.0, started_s + number / frames.rate_hz - time.monotonic()))
                service.send(message)
            wanted.clear()


def measured(service: LiveService, client: Client, sending: Event, viewer_pid: int) -> Round:
    """Measure one round on an empty map."""
    assert client.control("reset").ok
    pids = family(service.process.pid)
    with client.poller(POSE_TRACKED.name, TrackedPose, keep=DETAILS) as inbox:
        before_s, viewer_before_s = cpu_s(pids), cpu_s([viewer_pid])
        started_s = time.monotonic()
        sending.set()
        while sending.is_set():
            time.sleep(0.01)
        took_s = time.monotonic() - started_s
        used_s, viewer_s = cpu_s(pids) - before_s, cpu_s([viewer_pid]) - viewer_before_s
        poses = len(inbox())
    return Round(poses / took_s, 1e3 * used_s / poses, viewer_s / took_s)


def family(pid: int) -> list[int]:
    """Return the ids of a process and of its descendants."""
    children = Path(f"/proc/{pid}/task").glob("*/children")
    started = [int(word) for file in children for word in file.read_text().split()]
    return [pid, *(one for child in started for one in family(child))]


def cpu_s(pids: list[int]) -> float:
    stats = [Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split() for pid in pids]
    return sum(int(stat[11]) + int(stat[12]) for stat in stats) / TICKS


def pairs_of(count: int, frames: Frames) -> list[tuple[Round, Round]]:
    """Return pairs of rounds, with and without the viewer."""
    context, pairs = multiprocessing.get_context("spawn"), []
    wanted, is_ready, sending = context.Event(), context.Event(), context.Event()
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        service = stack.enter_context(live_service(Path(folder)))
        service.wait_for_actors()
        viewer = context.Process(target=look, args=(service.endpoint, wanted, is_ready))
        camera = context.Process(target=send, args=(service.endpoint, frames, sending))
        for process in (viewer, camera):
            process.start()
            stack.callback(process.kill)
        client = stack.enter_context(connect("robot", service.endpoint))
        assert viewer.pid is not None
        for number in range(-1, count):  # The first pair is for warm-up.
            rounds = {}
            for has_viewer in (True, False) if number % 2 else (False, True):
                (wanted.set if has_viewer else wanted.clear)()
                while is_ready.is_set() != has_viewer:
                    time.sleep(0.05)
                rounds[has_viewer] = measured(service, client, sending, viewer.pid)
            if number >= 0:
                pairs.append((rounds[True], rounds[False]))
                print(*pairs[-1], file=sys.stderr, flush=True)
        service.stop()
    return pairs


def default_source() -> str:
    data = os.environ.get("LDO_DATA")
    return str(Path(data) / "tum/kitchen") if data else "synthetic:room"


def quartiles(values: list[float]) -> str:
    low, middle, high = np.percentile(values, (25, 50, 75))
    return f"{middle:.3f} ({low:.3f} to {high:.3f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", nargs="?", default=default_source())
    parser.add_argument("--pairs", type=int, default=16)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--frames", type=int, default=300)
    arguments = parser.parse_args()
    frames = Frames(arguments.source, arguments.frames, arguments.rate)
    pairs = pairs_of(arguments.pairs, frames)
    with_, without = ([pair[side] for pair in pairs] for side in (0, 1))
    print("| median (quartiles) | without | with | with / without, per pair |\n|---|---|---|---|")
    for name, of in (
        ("frames handled, Hz", lambda one: one.poses_hz),
        ("CPU of the service per frame, ms", lambda one: one.cpu_ms),
    ):
        ratios = [of(a) / of(b) for a, b in pairs]
        cells = (quartiles([of(one) for one in rounds]) for rounds in (without, with_))
        print(f"| {name} | {' | '.join(cells)} | {quartiles(ratios)} |")
    shares = (quartiles([one.viewer_share for one in rounds]) for rounds in (without, with_))
    print(f"| CPU of the viewer, fraction of a core | {' | '.join(shares)} | |")


if __name__ == "__main__":
    main()
