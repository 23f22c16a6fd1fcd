"""CPU time of the mapper per message at its minimum effort, and a digest of all its outputs.

    python tests/bench/bench_mapper.py RUN [--keyframes N] [--skip N]

RUN: folder of a run that was made with `ldo run --keep-front-end`. The mapper handles the recorded
keyframes and boxes as if more keyframes were waiting, so each keyframe gets the least iterations.
To compare two checkouts, call this file with the Python of either checkout: equal digests mean
equal messages and an equal map, bit for bit.
"""

import argparse
import hashlib
import time
from pathlib import Path

from ldo_service.actors.mapper import Mapper
from ldo_service.config import actor_parameters, load_config
from ldo_service.recordings.mcap_file import McapIndex
from ldo_service.runs.front_end import FrontEnd
from ldo_service.runtime.actor import FlowStatus
from ldo_service.runtime.step import produce
from ldo_service.schemas import DetectionBoxes, Keyframe
from ldo_service.schemas.topics import KEYFRAME_NEW

WAITING = 9  # Number of waiting keyframes that is reported to the mapper.


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--keyframes", type=int, default=80, help="keyframes to map")
    parser.add_argument("--skip", type=int, default=27, help="first keyframes, which do not count")
    arguments = parser.parse_args()
    recorded = FrontEnd(0, McapIndex(arguments.run / "front_end.mcap"))
    mapper = Mapper(actor_parameters(load_config()).mapper, has_labeller=True)
    digest, seen = hashlib.sha256(), 0
    cpu_s: dict[str, list[float]] = {"Keyframe": [], "DetectionBoxes": []}
    for message in (one for frame in recorded for one in frame):
        if not isinstance(message, Keyframe | DetectionBoxes):
            continue
        seen += isinstance(message, Keyframe)
        if seen > arguments.keyframes:
            break
        mapper.situation = FlowStatus(backlog={KEYFRAME_NEW: WAITING})
        start = time.process_time()
        outputs = produce(mapper, mapper.handle(message))
        if seen > arguments.skip:
            cpu_s[type(message).__name__].append(time.process_time() - start)
        for output in outputs:
            digest.update(output.body)
    for _, output in sorted(mapper.snapshot()["map"]["map"]["map"].items()):
        digest.update(output.tobytes())
    times = ", ".join(
        f"{name} {1e3 * sum(values) / max(len(values), 1):.1f} ms ({len(values)})"
        for name, values in cpu_s.items()
    )
    print(f"{times}, digest {digest.hexdigest()[:16]}")


if __name__ == "__main__":
    main()
