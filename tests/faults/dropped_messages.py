"""Large messages over a slow network, and small ones beside a stopped subscriber.

    .venv/bin/python -m tests.faults.dropped_messages
    .venv/bin/python -m tests.faults.dropped_messages --wait-us 50000 --fragments-us 1000000
    .venv/bin/python -m tests.faults.dropped_messages --block

Zenoh drops a message if its queue stays full for longer than `wait_before_drop`, and a large one if
that lasts longer than `max_wait_before_drop_fragments`. With `--block`, large messages are sent
with BLOCK and a lower priority. The program needs root; see `bad_network`.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from threading import Thread

import zenoh

from ldo_service.transport.endpoint import CLOSED

from .bad_network import (
    ADDRESSES,
    HOST,
    ROBOT,
    NamespacesUnavailable,
    command_in,
    enter_namespace,
    two_namespaces,
)

ENDPOINT = f"tcp/{ADDRESSES[ROBOT]}:7447"
DROP = "transport/link/tx/queue/congestion_control/drop"
DELAY_S = 0.005
# Rate in megabits per second, bytes of a message, and messages of a burst.
LOADS = ((100, 1_500_000, 1), (100, 1_500_000, 4), (100, 4_000_000, 1), (20, 300_000, 8))
BURSTS = 4
BESIDE_S = 10.0  # Duration of the measurement beside a stopped subscriber.

SUBSCRIBER = """
import json, sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
count = 0
def take(sample):
    global count
    count += 1
handler = zenoh.handlers.Callback(take, indirect=False)
with zenoh.open(config) as session:
    subscriber = session.declare_subscriber("ldo/**", handler)
    print("listening", flush=True)
    for _ in sys.stdin:
        print(count, flush=True)
        count = 0
"""


class Subscriber:
    """Program on the other host that counts messages."""

    def __init__(self, stack: ExitStack) -> None:
        command = command_in(HOST, sys.executable, "-c", SUBSCRIBER, ENDPOINT)
        self.process = subprocess.Popen(command, stdin=-1, stdout=-1, text=True, bufsize=1)
        stack.callback(lambda: (self.process.kill(), self.process.wait()))
        self._line()

    def _line(self) -> str:
        assert self.process.stdout
        return self.process.stdout.readline()

    def count(self) -> int:
        """Return the number of messages since the last call."""
        assert self.process.stdin
        print(file=self.process.stdin)
        return int(self._line())


def run(waits_us: tuple[int, int], blocks: bool) -> None:
    config = zenoh.Config()
    settings = {
        **CLOSED,
        "mode": "router",
        "listen/endpoints": [ENDPOINT],
        f"{DROP}/wait_before_drop": waits_us[0],
        f"{DROP}/max_wait_before_drop_fragments": waits_us[1],
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with ExitStack() as stack:
        network = stack.enter_context(two_namespaces(seed=1))
        enter_namespace(ROBOT)
        session = stack.enter_context(zenoh.open(config))
        drop = zenoh.CongestionControl.DROP
        large = session.declare_publisher("ldo/large", congestion_control=drop)
        if blocks:
            large = session.declare_publisher(
                "ldo/large",
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
            )
        small = session.declare_publisher("ldo/small", congestion_control=drop)
        one, other = Subscriber(stack), Subscriber(stack)
        time.sleep(0.5)
        for megabits, size, burst in LOADS:
            for way in (network.out, network.back):
                way.delay_s, way.bytes_per_s = DELAY_S, megabits * 1e6 / 8
            for _ in range(BURSTS):
                for _ in range(burst):
                    large.put(os.urandom(size))
                time.sleep(0.5 + 2 * 1.3 * burst * size / network.out.bytes_per_s)
            came = f"{one.count()} and {other.count()} of {BURSTS * burst}"
            print(f"{megabits} Mbit/s, bursts of {burst} x {size / 1e3:.0f} kB: {came} arrive")
        network.heal()
        other.process.send_signal(signal.SIGSTOP)
        until_s, took_s = time.monotonic() + BESIDE_S, []

        def send_large() -> None:
            while time.monotonic() < until_s:
                large.put(os.urandom(1_500_000))
                time.sleep(0.5)

        thread = Thread(target=send_large)
        thread.start()
        while time.monotonic() < until_s:
            started_s = time.monotonic()
            small.put(bytes(200))
            took_s.append(time.monotonic() - started_s)
            time.sleep(0.03)
        thread.join()
        print(f"beside a stopped subscriber, a small message takes at most {max(took_s):.3f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--wait-us", type=int, default=1000, help="wait_before_drop")
    parser.add_argument("--fragments-us", type=int, default=50_000)
    parser.add_argument("--block", action="store_true")
    given = parser.parse_args()
    try:
        run((given.wait_us, given.fragments_us), given.block)
    except NamespacesUnavailable as error:
        raise SystemExit(f"not run: {error}") from error


if __name__ == "__main__":
    main()
