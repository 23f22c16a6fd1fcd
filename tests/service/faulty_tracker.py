"""Command `ldo` with a tracker that has a fault at frame 20.

The environment variable FAULT selects the fault:

- hang: The handler of the first process that reaches the frame does not return.
- once: The handler raises at each attempt of that frame.
- always: The handler raises at every frame from there on.
"""

import os
import sys
import time
from dataclasses import replace
from pathlib import Path

from ldo_service.actors import topology
from ldo_service.actors.tracker import Tracker
from ldo_service.commands import cli
from ldo_service.schemas import FrameRgbd, GraphCorrection
from ldo_service.service import service

FAULT, FRAME = os.environ["FAULT"], 20
HUNG = Path(os.environ["FAULT_FOLDER"]) / "has_hung"


class FaultyTracker(Tracker):
    def handle(self, message: FrameRgbd | GraphCorrection):
        if isinstance(message, FrameRgbd):
            inject_fault(message.frame)
        yield from super().handle(message)


def inject_fault(frame: int) -> None:
    if FAULT == "hang" and frame >= FRAME and not HUNG.exists():
        HUNG.touch()
        time.sleep(1e6)
    if frame == FRAME if FAULT == "once" else FAULT == "always" and frame >= FRAME:
        raise RuntimeError(f"injected failure at frame {frame}")


def with_fault(box: topology.ActorSpec) -> topology.ActorSpec:
    if box.name != "tracker":
        return box
    return replace(box, make=lambda parameters: FaultyTracker(parameters.tracker))


if __name__ == "__main__":
    service.GRAPH = tuple(map(with_fault, service.GRAPH))
    service.python_command = lambda *arguments: [sys.executable, __file__, *arguments]
    cli.main(sys.argv[1:])
