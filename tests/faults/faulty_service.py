"""Command `ldo` with faults that files in the folder of the variable FAULT_FOLDER switch on.

- `hang-ACTOR`: The next step of that actor hangs, and the file is removed.
- `poison`: The next keyframe of the optimizer becomes poison: each time the optimizer handles it,
  it kills its process. The file becomes `poison-KEYFRAME`, with a line for each of these times.
- `bad_network`: Messages are lost, late and out of order while the file exists.
- `bad_disk`: Renames, removals, syncs and new folders often fail while the file exists.
- `refusals`: The service appends a byte for each disk call that failed on purpose.
"""

import errno
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from threading import Timer
from typing import Any

from ldo_service.commands import cli
from ldo_service.runtime import Actor
from ldo_service.runtime.stage import Stage
from ldo_service.schemas import KeyframeMeasurements
from ldo_service.service import service
from ldo_service.transport.interface import OnMessage
from ldo_service.transport.zenoh_transport import ZenohTransport

FOLDER = Path(os.environ["FAULT_FOLDER"])
BAD_NETWORK, BAD_DISK = FOLDER / "bad_network", FOLDER / "bad_disk"
POISON = FOLDER / "poison"
LOST, LATE, MAX_DELAY_S = 0.15, 0.4, 0.3  # Fractions of the messages, and their maximum delay.
REFUSED, REASONS = 0.5, (errno.ENOSPC, errno.EIO, errno.EROFS)  # Fraction of calls, and errors.
REFUSALS = "refusals"
DISK_CALLS = ("rename", "replace", "unlink", "fsync", "mkdir")  # Functions of `os`.


def hanging(actor: Actor) -> Actor:
    flag, handle = FOLDER / f"hang-{actor.name}", actor.handle

    def hang_or_handle(message: object):
        if flag.exists():
            flag.unlink()
            time.sleep(1e6)
        return handle(message)

    actor.handle = hang_or_handle
    return actor


def poisoned(actor: Actor) -> Actor:
    handle = actor.handle

    def die_or_handle(message: object):
        if isinstance(message, KeyframeMeasurements):
            deliveries = POISON.with_name(f"{POISON.name}-{message.keyframe}")
            if POISON.exists():
                POISON.rename(deliveries)
            if deliveries.exists():
                with deliveries.open("a") as lines:
                    print(time.time(), file=lines)
                os.kill(os.getpid(), signal.SIGKILL)
        return handle(message)

    actor.handle = die_or_handle
    return actor


class FaultyStage(Stage):
    def __init__(self, make: Callable[[], Actor], *args: Any, **options: Any) -> None:
        super().__init__(lambda: poisoned(hanging(make())), *args, **options)


class BadTransport(ZenohTransport):
    def subscribe(self, key: str, on_message: OnMessage) -> None:
        rng = Random(key)

        def deliver_or_not(header: bytes, body: memoryview) -> None:
            if not BAD_NETWORK.exists():
                on_message(header, body)
                return
            fate = rng.random()
            if fate >= LOST + LATE:
                on_message(header, body)
            elif fate >= LOST:
                late = Timer(MAX_DELAY_S * rng.random(), on_message, (header, body))
                late.daemon = True
                late.start()

        super().subscribe(key, deliver_or_not)


def refused_at_times(name: str) -> Callable[..., Any]:
    """Return a function of `os` that fails at random while the bad disk is switched on."""
    call, rng = getattr(os, name), Random(f"{name}-{os.getpid()}")

    def call_or_refuse(*arguments: Any, **options: Any) -> Any:
        if BAD_DISK.exists() and rng.random() < REFUSED:
            with (FOLDER / REFUSALS).open("ab") as refusals:
                refusals.write(b".")
            reason = rng.choice(REASONS)
            raise OSError(reason, os.strerror(reason), f"{name} of {arguments[0]}")
        return call(*arguments, **options)

    return call_or_refuse


if __name__ == "__main__":
    for name in DISK_CALLS:
        setattr(os, name, refused_at_times(name))
    service.Stage = FaultyStage
    service.ZenohTransport = BadTransport
    service.python_command = lambda *arguments: [sys.executable, __file__, *arguments]
    cli.main(sys.argv[1:])
