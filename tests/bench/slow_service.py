"""Command `ldo` with actors that take a given time longer for each message.

The environment variable SLOW has a JSON object with the seconds by actor, for example
`{"optimizer": 4}`. `{"optimizer": {"hold_gil_once": 60}}` holds the GIL of the actor's process for
60 s in one step. Both end when the file of the variable RECOVERED exists.
"""

import ctypes
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ldo_service.commands import cli
from ldo_service.runtime import Actor
from ldo_service.runtime.stage import Stage
from ldo_service.schemas import DetectionBoxes, Keyframe, KeyframeMeasurements, LabelRequest
from ldo_service.service import service

SLOW: dict[str, Any] = json.loads(os.environ["SLOW"])
RECOVERED = Path(os.environ["RECOVERED"])
# Message of each actor that takes longer: one for each keyframe, or each label request.
SLOW_MESSAGES = {
    "optimizer": KeyframeMeasurements,
    "loop_closer": DetectionBoxes,
    "detector": Keyframe,
    "vlm_labeller": LabelRequest,
}
HOLD_AFTER = 20  # Messages before the step that holds the GIL.


def slowed(actor: Actor) -> Actor:
    slow, handle = SLOW.get(actor.name), actor.handle
    if slow is None:
        return actor
    handled = 0

    def handle_slowly(message: object):
        nonlocal handled
        if isinstance(message, SLOW_MESSAGES[actor.name]) and not RECOVERED.exists():
            handled += 1
            if not isinstance(slow, dict):
                time.sleep(slow)
            elif handled == HOLD_AFTER:
                ctypes.PyDLL(None).sleep(slow["hold_gil_once"])
        return handle(message)

    actor.handle = handle_slowly
    return actor


class SlowStage(Stage):
    def __init__(self, make: Callable[[], Actor], *args: Any, **options: Any) -> None:
        super().__init__(lambda: slowed(make()), *args, **options)


if __name__ == "__main__":
    service.Stage = SlowStage
    service.python_command = lambda *arguments: [sys.executable, __file__, *arguments]
    cli.main(sys.argv[1:])
