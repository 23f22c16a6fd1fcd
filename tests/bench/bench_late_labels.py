"""Object names with slow back ends, in a simulation of the service in logical time.

    python -m tests.bench.bench_late_labels [--source synthetic:tour-noisy] [--frames N] [--hz 3]
                                            [--only nothing detector ...] [--set SETTING ...]

Each row simulates the service over the same frames. The named actors take the given time for each
keyframe or label request until the last frame is sent. Then the camera stands still until no actor
has work. The output compares the objects of each row with those of the first row. Two objects match
if they have the same name and their centers are at most 0.3 m apart.
"""

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from ldo_service.actors.topology import make_actors
from ldo_service.config import actor_parameters, load_config
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.datasets import open_sequence
from ldo_service.schemas import (
    CameraRgbd,
    DetectionBoxes,
    GraphCorrection,
    Keyframe,
    KeyframeMeasurements,
    LabelRequest,
    MapObject,
    MapObjects,
    Message,
)
from tests.runs.simulated_service import STEP_S, SimulatedService

MAX_DISTANCE_M = 0.3
DELAYS_S = {"optimizer": 4.0, "loop_closer": 3.0, "detector": 2.0, "vlm_labeller": 5.0}
SLOW_BACKENDS = {
    "nothing": (),
    **{name: (name,) for name in DELAYS_S},
    "all": tuple(DELAYS_S),
}
# Message of each actor that takes longer: one for each keyframe, or each label request.
SLOW_MESSAGES = {
    "optimizer": KeyframeMeasurements,
    "loop_closer": DetectionBoxes,
    "detector": Keyframe,
    "vlm_labeller": LabelRequest,
}


class Run:
    """Simulated service; the actors in `slowed` are slow while frames arrive."""

    def __init__(self, slowed: tuple[str, ...], settings: list[str], folder: Path) -> None:
        config = load_config(settings=(*settings, f"mapper.image_folder={folder}"))
        self._slowed, self._frames_end_s = slowed, 0.0
        self.objects: tuple[MapObject, ...] = ()
        self.closures = self.requests = 0
        self.service = SimulatedService(
            make_actors(actor_parameters(config)), self._step_s, self._observe
        )

    def run(self, frames: list[CameraRgbd], hz: float) -> None:
        self._frames_end_s = len(frames) / hz
        self.service.run(frames, 1 / hz)

    def _step_s(self, actor: str, message: Message, now_s: float) -> float:
        is_slow = actor in self._slowed and now_s < self._frames_end_s
        if is_slow and isinstance(message, SLOW_MESSAGES[actor]):
            return DELAYS_S[actor]
        return STEP_S.get(actor, 0.0)

    def _observe(self, _actor: str, message: Message, _now_s: float) -> None:
        match message:
            case MapObjects():
                self.objects = message.objects
            case GraphCorrection():
                self.closures = len(message.accepted_closures)
            case LabelRequest():
                self.requests += 1


def matched(objects: tuple[MapObject, ...], others: tuple[MapObject, ...]) -> int:
    """Return the number of objects that match another one of the same name, one to one."""
    a = np.array([one.centroid for one in objects]).reshape(-1, 1, 3)
    b = np.array([one.centroid for one in others]).reshape(1, -1, 3)
    is_same = np.array([[one.name == other.name for other in others] for one in objects])
    is_same = is_same.reshape(len(objects), len(others))
    is_same &= np.linalg.norm(a - b, axis=-1) <= MAX_DISTANCE_M
    rows, columns = linear_sum_assignment(is_same, maximize=True)
    return int(is_same[rows, columns].sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--source", default="synthetic:tour-noisy")
    parser.add_argument("--frames", type=int)
    parser.add_argument("--hz", type=float, default=3.0)
    parser.add_argument("--only", nargs="+", default=list(SLOW_BACKENDS), choices=SLOW_BACKENDS)
    networks = ["detector.model=demo", "vlm_labeller.model=demo"]
    parser.add_argument("--set", nargs="+", default=networks, dest="settings")
    options = parser.parse_args()
    sequence = open_sequence(options.source)
    count = min(options.frames or len(sequence), len(sequence))
    frames = [raw_frame_to_message(sequence.read(index)) for index in range(count)]
    reference: Run | None = None
    for slowed in dict.fromkeys(("nothing", *options.only)):
        started_s = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            run = Run(SLOW_BACKENDS[slowed], options.settings, Path(folder))
            run.run(frames, options.hz)
            facts = run.service.actor("mapper").metrics()
        reference = reference or run
        names = Counter(one.name for one in run.objects)
        before = Counter(one.name for one in reference.objects)
        print(
            f"{slowed:13} objects {len(run.objects):3d} "
            f"matched {matched(run.objects, reference.objects):3d} "
            f"missing {dict(before - names)} new {dict(names - before)} closures {run.closures} "
            f"requests {run.requests} named {facts.get('answers_named')} "
            f"expired {facts.get('label_requests_expired')} "
            f"second passes {facts.get('labels_reordered'):.0f} keyframes {facts.get('keyframes')} "
            f"CPU {time.process_time() - started_s:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
