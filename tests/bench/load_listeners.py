"""Subscribers of bench_load in one process: arguments endpoint, count, kind (quick, slow, dead).

Each subscriber has its own session and subscribes to poses, map and health of all robots. A slow
one waits a second in each callback, so that its receive buffers fill up. bench_load stops the
process of dead ones. At the end of its input, a process of quick ones prints its message counts as
JSON.
"""

import json
import sys
import time
from contextlib import ExitStack

import zenoh

from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.zenoh_transport import open_session

TOPICS: tuple[str, ...] = (
    "ldo/*/pose/tracked",
    "ldo/*/map/delta",
    "ldo/*/map/snapshot",
    "ldo/*/health/*",
)


class Listener:
    def __init__(self, is_slow: bool) -> None:
        self.is_slow, self.counts = is_slow, dict.fromkeys(TOPICS, 0)

    def subscribe(self, session: zenoh.Session, stack: ExitStack) -> None:
        for topic in TOPICS:

            def heard(_sample: zenoh.Sample, topic: str = topic) -> None:
                self.counts[topic] += 1
                if self.is_slow:
                    time.sleep(1.0)

            handler = zenoh.handlers.Callback(heard, indirect=False)
            stack.enter_context(session.declare_subscriber(topic, handler))


def main(endpoint: str, count: str, kind: str) -> None:
    listeners = [Listener(kind == "slow") for _ in range(int(count))]
    with ExitStack() as stack:
        for listener in listeners:
            session = stack.enter_context(open_session(Endpoint("robot0", endpoint)))
            listener.subscribe(session, stack)
        print("ready", flush=True)
        sys.stdin.read()
        print(json.dumps([listener.counts for listener in listeners]), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
