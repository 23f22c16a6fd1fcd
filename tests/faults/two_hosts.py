"""Live service with actors on another host, behind a network that loses, delays and cuts packets.

    .venv/bin/python -m tests.faults.two_hosts two_hosts.jsonl --trials 20 --seed 1

The program needs root: it makes two network namespaces (`bad_network`). In each trial the network
is bad for 10 to 25 s, and then heals. After that, each actor must go on, and as many messages must
have been handled as were sent, on each lossless link between the hosts. Afterwards, the program
measures commands beside readers of the map, of which some are stopped. It prints medians and
maxima, and its exit code is 1 after a violation.
"""

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from math import inf
from pathlib import Path
from statistics import median
from tempfile import mkdtemp
from typing import Any

from ldo_service.actors.topology import GRAPH
from ldo_service.client import Client, connect
from ldo_service.errors import ConfigError
from ldo_service.runtime.actor_graph import lossless, producers
from ldo_service.schemas import Health, TrackedPose

from .bad_network import (
    ADDRESSES,
    HOST,
    ROBOT,
    BadNetwork,
    NamespacesUnavailable,
    command_in,
    enter_namespace,
    two_namespaces,
)
from .camera import CameraStream, frames

REMOTE = ("optimizer", "detector", "vlm_labeller")
ENDPOINT = f"tcp/{ADDRESSES[ROBOT]}:7447"
SETTINGS = (
    *("detector.model=demo", "vlm_labeller.model=demo", "mapper.threads=1", "mapper.iterations=2"),
    "supervision.heartbeat_s=0.25",
)
RATE_HZ = 4.0
PATIENCE_S = 60.0  # Time limit of a start on a busy machine.
BAD_S, LOSS, DELAY_S, CUT_S = (10.0, 25.0), (0.01, 0.2), (0.05, 0.5), (2.0, 15.0)
CUTS = ("none", "to the host", "from the host", "both", "resets")
RESUMED_WITHIN_S, HANDLED_WITHIN_S = 5.0, 60.0
READERS, STOPPED, COMMANDS = 20, 3, 120

# Each lossless link between the hosts: producer, topic and consumer.
CROSSING = [
    (producers(GRAPH)[port.topic.name], port.topic.name, box.name)
    for box in GRAPH
    for port in lossless(box)
    if (producers(GRAPH)[port.topic.name] in REMOTE) != (box.name in REMOTE)
]
# Inputs that show that results of the remote actors arrive: consumer and topic.
RESULTS = (("mapper", "detection/boxes"), ("tracker", "graph/correction"))

# Program that reads the map again and again. Arguments: endpoint and number of readers.
READER = """
import sys, time
from threading import Thread
from ldo_service.client import connect
counts = [0] * int(sys.argv[2])
def read(number):
    with connect("robot", sys.argv[1]) as client:
        while True:
            counts[number] += bool(client.latest("map/snapshot", 30.0))
            time.sleep(1.0)
for number in range(len(counts)):
    Thread(target=read, args=(number,), daemon=True).start()
until_s = time.monotonic() + 60.0
while not all(counts):
    if time.monotonic() > until_s:
        sys.exit("no map")
    time.sleep(0.1)
print("reading", flush=True)
sys.stdin.readline()
"""


@dataclass
class Trial:
    """One trial and its result."""

    number: int
    loss: float
    delay_s: float
    bad_s: float
    cut: str  # One of `CUTS`.
    cut_s: float  # Duration of the cut, which ends with the bad network, seconds.
    resumed_s: float = -1.0  # Time from healing to a result of each kind; -1: none came.
    handled_s: float = -1.0  # Time from healing until all messages are handled; -1: never.
    pose_gap_s: float = 0.0  # Maximum time between two poses.
    poses: int = 0
    messages: int = 0  # Messages that crossed on lossless links since the start of the service.
    violations: list[str] = field(default_factory=list)


class Watch:
    """Poses and heartbeats of a service."""

    def __init__(self, client: Client, stack: ExitStack) -> None:
        self._healths = stack.enter_context(client.poller("health/*", Health))
        self._poses = stack.enter_context(client.poller("pose/tracked", TrackedPose))
        self.health: dict[str, Health] = {}
        self.came_s: dict[str, float] = {}  # Time of the last heartbeat, by actor.
        self.poses, self.pose_gap_s, self._last_pose_s = 0, 0.0, time.monotonic()

    def restart(self) -> None:
        """Forget the poses so far."""
        self.update()
        self.poses, self.pose_gap_s, self._last_pose_s = 0, 0.0, time.monotonic()

    def update(self) -> None:
        """Take all new messages."""
        now_s = time.monotonic()
        for health in self._healths():
            self.health[health.actor], self.came_s[health.actor] = health, now_s
        if new := self._poses():
            self.poses += len(new)
            self._last_pose_s = now_s
        self.pose_gap_s = max(self.pose_gap_s, now_s - self._last_pose_s)

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> float:
        """Wait for a condition, and return the time it took; -1 if it never became true."""
        started_s = time.monotonic()
        while (took_s := time.monotonic() - started_s) < timeout_s:
            self.update()
            if condition():
                return took_s
            time.sleep(0.02)
        return -1.0

    def sleep(self, duration_s: float) -> None:
        """Take messages for a while."""
        self.wait(lambda: False, duration_s)

    def delivered(self, actor: str, topic: str) -> int:
        """Return the number of messages of a topic that an actor has handled."""
        health = self.health.get(actor)
        counts = health.inputs if health else ()
        return sum(count.delivered for count in counts if count.topic == topic)

    def sent(self, actor: str, topic: str) -> int:
        """Return the number of messages that an actor has sent on a topic."""
        health = self.health.get(actor)
        counts = health.outputs if health else ()
        return sum(count.sent for count in counts if count.topic == topic)

    def differences(self) -> list[str]:
        """Return a text for each link of which sent and handled messages differ."""
        found = []
        for producer, topic, consumer in CROSSING:
            sent, taken = self.sent(producer, topic), self.delivered(consumer, topic)
            if sent != taken:
                found.append(f"{consumer} handled {taken} of {sent} messages on {topic}")
        return found

    def faults(self, processes: dict[str, tuple[int, int]]) -> list[str]:
        """Return a text for each actor that was restarted or failed."""
        return [
            f"{name}: process {health.pid}, {health.failures} failures"
            for name, health in self.health.items()
            if (health.pid, health.epoch) != processes[name] or health.failures
        ]


def run_trial(trial: Trial, network: BadNetwork, watch: Watch, camera: CameraStream) -> None:
    """Let the network be bad for a while, and note how the service goes on."""
    watch.restart()
    for way in (network.out, network.back):
        way.loss, way.delay_s = trial.loss, trial.delay_s
    watch.sleep(trial.bad_s - trial.cut_s)
    if trial.cut == "resets":
        for _ in range(int(trial.cut_s)):
            network.reset_connections(0.5)
            watch.sleep(1.0)
    else:
        network.out.is_cut = trial.cut in ("to the host", "both")
        network.back.is_cut = trial.cut in ("from the host", "both")
        watch.sleep(trial.cut_s)
    watch.update()
    before = {result: watch.delivered(*result) for result in RESULTS}
    network.heal()
    healed_s = time.monotonic()
    trial.resumed_s = watch.wait(
        lambda: all(watch.delivered(*result) > count for result, count in before.items()), 20.0
    )
    trial.poses, trial.pose_gap_s = watch.poses, watch.pose_gap_s
    camera.stop()
    if watch.wait(lambda: not watch.differences(), HANDLED_WITHIN_S) < 0:
        trial.violations += watch.differences()
    else:
        trial.handled_s = time.monotonic() - healed_s
    trial.messages = sum(watch.sent(producer, topic) for producer, topic, _ in CROSSING)


def draw(seed: int, count: int) -> list[Trial]:
    """Return random trials; the kinds of cuts take turns."""
    rng, trials = random.Random(seed), []
    for number in range(count):
        bad_s, cut_s, cut = rng.uniform(*BAD_S), rng.uniform(*CUT_S), CUTS[number % len(CUTS)]
        cut_s = 0.0 if cut == "none" else min(cut_s, bad_s - 1.0)
        loss, delay_s = rng.uniform(*LOSS), rng.uniform(*DELAY_S)
        trials.append(Trial(number, loss, delay_s, bad_s, cut, cut_s))
    return trials


def summary(trials: list[Trial]) -> str:
    """Return the lines of a table: median and maximum times of each kind of cut."""
    lines = []
    for cut in CUTS:
        done = [trial for trial in trials if trial.cut == cut]
        if done:
            resumed_s = [trial.resumed_s if trial.resumed_s >= 0 else inf for trial in done]
            handled_s = [trial.handled_s if trial.handled_s >= 0 else inf for trial in done]
            lines.append(
                f"{cut}: {len(done)} trials, results again after {median(resumed_s):.1f} / "
                f"{max(resumed_s):.1f} s, all messages handled after {median(handled_s):.1f} / "
                f"{max(handled_s):.1f} s"
            )
    soon = sum(0 <= trial.resumed_s <= RESUMED_WITHIN_S for trial in trials)
    failed = sum(bool(trial.violations) for trial in trials)
    pose_gap_s = max((trial.pose_gap_s for trial in trials), default=0.0)
    lines.append(
        f"{len(trials)} trials, {soon} with results within {RESUMED_WITHIN_S:g} s, {failed} with "
        f"violations; poses at most {pose_gap_s:.1f} s apart"
    )
    return "\n".join(lines)


class Hosts:
    """Processes of the service on both hosts."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack

    def start(self, namespace: str, *arguments: str, **options: Any) -> "subprocess.Popen[str]":
        """Start a Python program in a namespace."""
        command = command_in(namespace, sys.executable, *arguments)
        process = subprocess.Popen(command, text=True, **options)
        self._stack.callback(lambda: (process.kill(), process.wait()))
        return process

    def serve(self, namespace: str, name: str, *arguments: str) -> None:
        """Start processes of the service."""
        log = self._stack.enter_context((self._folder / f"{name}.log").open("w"))
        settings = [word for setting in SETTINGS for word in ("--set", setting)]
        program = ("-m", "ldo_service", "serve", "--endpoint", ENDPOINT)
        state = ("--state", str(self._folder / name))
        self.start(namespace, *program, *state, *settings, *arguments, stderr=log)

    def connect(self) -> Client:
        """Connect to the service, which has just been started."""
        until_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                return self._stack.enter_context(connect("robot", ENDPOINT))
            except ConfigError:
                if time.monotonic() > until_s:
                    raise
                time.sleep(0.3)


def measure_commands(hosts: Hosts, client: Client, network: BadNetwork) -> dict[str, object]:
    """Measure commands beside readers on the other host, of which some are stopped."""
    for way in (network.out, network.back):
        way.delay_s = 0.05
    readers = [
        hosts.start(HOST, "-c", READER, ENDPOINT, str(count), stdin=-1, stdout=-1)
        for count in (READERS - STOPPED, STOPPED)
    ]
    for reader in readers:  # Each reader has read the map once.
        assert reader.stdout
        if reader.stdout.readline() != "reading\n":
            raise SystemExit("a process that reads the map ended before it had read the map")
    readers[1].send_signal(signal.SIGSTOP)
    took_s, refused = [], 0
    for number in range(COMMANDS):
        started_s = time.monotonic()
        answer = client.control(("pause", "resume", "save")[number % 3])
        took_s.append(time.monotonic() - started_s)
        refused += not answer.ok
    took_s.sort()
    return {
        "readers": READERS,
        "stopped": STOPPED,
        "commands": COMMANDS,
        "refused": refused,
        "p50_s": took_s[COMMANDS // 2],
        "p99_s": took_s[int(0.99 * COMMANDS)],
        "max_s": took_s[-1],
    }


def run(out: Path, trials: list[Trial], seed: int) -> None:
    with ExitStack() as stack, out.open("w") as lines:
        network = stack.enter_context(two_namespaces(seed))
        folder = Path(mkdtemp(prefix="ldo-hosts-"))
        hosts = Hosts(folder, stack)
        # Sessions of this program, and the threads of the camera, are on the robot.
        enter_namespace(ROBOT)
        remote = f"service.remote_actors=[{','.join(REMOTE)}]"
        hosts.serve(ROBOT, "robot", "--insecure", "--set", remote)
        actors = [word for actor in REMOTE for word in ("--actor", actor)]
        client = hosts.connect()
        hosts.serve(HOST, "host", "--client", *actors)
        watch = Watch(client, stack)
        if watch.wait(lambda: len(watch.health) == len(GRAPH), PATIENCE_S) < 0:
            raise SystemExit(
                f"only these actors have started: {sorted(watch.health)}; the logs are in {folder}"
            )
        processes = {name: (health.pid, health.epoch) for name, health in watch.health.items()}
        camera = CameraStream(frames(), RATE_HZ)
        for trial in trials:
            camera.start(client)
            watch.sleep(3.0)
            run_trial(trial, network, watch, camera)
            trial.violations += watch.faults(processes)
            print(json.dumps(asdict(trial)), file=lines, flush=True)
            print(trial, flush=True)
        commands = measure_commands(hosts, client, network)
        print(json.dumps(commands), file=lines, flush=True)
        print(commands, flush=True)
    if any(trial.violations for trial in trials):
        print(f"logs and states: {folder}")
    else:
        shutil.rmtree(folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="file for a JSON object per trial")
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    trials = draw(given.seed, given.trials)
    try:
        run(given.out, trials, given.seed)
    except NamespacesUnavailable as error:
        raise SystemExit(f"not run: {error}") from error
    finally:
        if done := [trial for trial in trials if trial.messages]:
            print(summary(done), flush=True)
    raise SystemExit(any(trial.violations for trial in trials))


if __name__ == "__main__":
    main()
