"""Program in which many readers read the whole map from a service, again and again.

    map_readers.py ENDPOINT COUNT

The program prints a line when the readers have started.
"""

import signal
import sys
import time
from pathlib import Path
from threading import Thread

import zenoh

sys.path.append(str(Path(__file__).resolve().parents[2]))

from tests.faults.earlier_names import found

KEY, MAX_S = "ldo/robot/map/snapshot", 300


def read(endpoint: str) -> None:
    with found("open_session")(found("Endpoint")("robot", endpoint)) as session:
        while True:
            for _ in session.get(KEY, timeout=60.0, consolidation=zenoh.ConsolidationMode.NONE):
                pass


if __name__ == "__main__":
    signal.alarm(MAX_S)
    for _ in range(int(sys.argv[2])):
        Thread(target=read, args=(sys.argv[1],), daemon=True).start()
    print("reading", flush=True)
    time.sleep(MAX_S)
