"""`ldo` with a tracker that has trouble at frame 20: arguments of `ldo`, and in the environment

TROUBLE=hang     the handler does not return, in the first process that gets there
TROUBLE=once     that frame makes it raise each time it is tried
TROUBLE=always   every frame from there on does
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

TROUBLE, FRAME = os.environ["TROUBLE"], 20
HUNG = Path(os.environ["TROUBLE_FOLDER"]) / "has_hung"


class TroubledTracker(Tracker):
    def handle(self, message: FrameRgbd | GraphCorrection):
        if isinstance(message, FrameRgbd):
            meet_trouble(message.frame)
        yield from super().handle(message)


def meet_trouble(frame: int) -> None:
    if TROUBLE == "hang" and frame >= FRAME and not HUNG.exists():
        HUNG.touch()
        time.sleep(1e6)
    if frame == FRAME if TROUBLE == "once" else TROUBLE == "always" and frame >= FRAME:
        raise RuntimeError(f"trouble at frame {frame}")


def troubled(box: topology.ActorSpec) -> topology.ActorSpec:
    if box.name != "tracker":
        return box
    return replace(box, make=lambda parameters: TroubledTracker(parameters.tracker))


if __name__ == "__main__":
    service.GRAPH = tuple(map(troubled, service.GRAPH))
    service.python_command = lambda *arguments: [sys.executable, __file__, *arguments]
    cli.main(sys.argv[1:])
