"""Command `ldo` with a network that loses keyframes, and with a log of the synced files.

The folder of the variable FAULT_FOLDER has the files. While `lose` exists, no process receives
messages of keyframe/new. Each process appends the path of each file that it syncs to `synced`. The
variable EVICT_AFTER_S has the time after which a consumer without progress is evicted.
"""

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[2]))

from ldo_service.runtime.stage import Stage
from tests.faults.earlier_names import found, module

FOLDER = Path(os.environ["FAULT_FOLDER"])
LOSE, SYNCED = "lose", "synced"
EVICT_AFTER_S = float(os.environ.get("EVICT_AFTER_S", "30"))


class EarlyEviction(Stage):
    def __init__(
        self, make: Callable[[], Any], *arguments: Any, config: Any, **options: Any
    ) -> None:
        config = replace(config, evict_after_s=EVICT_AFTER_S)
        super().__init__(make, *arguments, config=config, **options)


class LossyTransport(found("ZenohTransport")):
    def subscribe(self, key: str, on_message: Callable[..., None]) -> None:
        def deliver_or_not(header: bytes, body: memoryview) -> None:
            if not ("keyframe/new" in key and (FOLDER / LOSE).exists()):
                on_message(header, body)

        super().subscribe(key, deliver_or_not)


def log_of_syncs(fsync: Callable[[int], None]) -> Callable[[int], None]:
    def fsync_and_log(descriptor: int) -> None:
        fsync(descriptor)
        with (FOLDER / SYNCED).open("a") as log:
            print(os.readlink(f"/proc/self/fd/{descriptor}"), file=log)

    return fsync_and_log


if __name__ == "__main__":
    os.fsync = log_of_syncs(os.fsync)
    service = module("service")
    service.Stage, service.ZenohTransport = EarlyEviction, LossyTransport
    service.python_command = lambda *words: [sys.executable, __file__, *words]
    module("cli").main(sys.argv[1:])
