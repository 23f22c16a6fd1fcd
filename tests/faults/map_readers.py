"""Programs that read the whole map from a service.

    map_readers.py ENDPOINT readers COUNT     COUNT readers, each of which reads it again and again
    map_readers.py ENDPOINT stopped QUERIES   one reader, which sends QUERIES and stops (SIGSTOP)

Each program prints a line as soon as it reads. The second one sends its queries when it has read a
line from its standard input.
"""

import os
import signal
import sys
import time
from pathlib import Path
from threading import Thread

import zenoh

sys.path.append(str(Path(__file__).resolve().parents[2]))

from tests.faults.earlier_names import found

KEY, MAX_S = "ldo/robot/map/snapshot", 300


def replies(session: zenoh.Session):
    return session.get(KEY, timeout=60.0, consolidation=zenoh.ConsolidationMode.NONE)


def read(endpoint: str) -> None:
    with found("open_session")(found("Endpoint")("robot", endpoint)) as session:
        while True:
            for _ in replies(session):
                pass


def read_again_and_again(endpoint: str, count: int) -> None:
    for _ in range(count):
        Thread(target=read, args=(endpoint,), daemon=True).start()
    print("reading", flush=True)
    time.sleep(MAX_S)


def send_and_stop(endpoint: str, queries: int) -> None:
    with found("open_session")(found("Endpoint")("robot", endpoint)) as session:
        print("connected", flush=True)
        sys.stdin.readline()
        waiting = [replies(session) for _ in range(queries)]
        time.sleep(0.005)
        os.kill(os.getpid(), signal.SIGSTOP)
        del waiting


if __name__ == "__main__":
    signal.alarm(MAX_S)
    _, address, kind, number = sys.argv
    (read_again_and_again if kind == "readers" else send_and_stop)(address, int(number))
