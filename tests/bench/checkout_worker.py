"""Worker that tracks or maps with the code of one checkout, for comparisons of commits.

    python checkout_worker.py track SOURCE ["without self-calibration"]
    python checkout_worker.py map FOLDER EFFORT [FIELD=VALUE ...]

`checkouts.py` starts one worker per checkout and gives them turns. Each line on stdin is a task,
and the worker answers it with one line of JSON on stdout. The program must run in any checkout
since commit 18f9264, so it knows the earlier and the current form of names that have changed.

Tasks of `track` are numbers of frames. The answer has the CPU time of the tracker without the
decoding of images, the status, and T_odom_camera.

Tasks of `map` are names of keyframes that `bench_map_curves.py` has saved in FOLDER, or a path for
the map, which ends with ".npz". The answer has the CPU time of the map builder: the keyframe and
the rendering for `map/view`. FIELD is a field of `MapBuilderConfig`, as in `bench_map.py`.
"""

import json
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from time import process_time
from typing import Any

import cv2
import numpy as np

from ldo_service.datasets import open_sequence
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.geometry import Camera, RgbdFrame

Answer = dict[str, Any]
# Modules and names of the tracker, and of the conversions of frames and poses: now, and at commit
# 18f9264.
CURRENT = (
    ("ldo_service.actors.tracker", "Tracker"),
    ("ldo_service.conversions.frames", "frame_to_message"),
    ("ldo_service.conversions.poses", "pose_from_message"),
)
EARLIER = (
    ("actors.tracker", "Tracker"),
    ("ldo_service.wire", "rgbd_message"),
    ("ldo_service.wire", "transform"),
)


def peak_resident_mb() -> float:
    """Return the peak of the resident memory of this process.

    `getrusage` would give that of the parent if it is larger, because this process starts as its
    copy.
    """
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) / 1024 if found else 0.0


def tracker(source: str, is_calibrating: bool) -> Callable[[str], Answer]:
    """Return a function that tracks the frame of a task."""
    names = EARLIER if find_spec("ldo_service.wire") else CURRENT
    actor_type, to_message, from_message = (
        getattr(import_module(module), name) for module, name in names
    )
    config = import_module(names[0][0]).TrackerConfig()
    if not is_calibrating:
        config = replace(config, calibration=replace(config.calibration, views=()))
    sequence, actor = open_sequence(source), actor_type(config)

    def track(task: str) -> Answer:
        message = to_message(sequence[int(task)])
        start_s = process_time()
        made = list(actor.handle(message))
        cpu_s = process_time() - start_s
        pose = made[-1]  # The pose is the last message of a frame.
        T_odom_camera = from_message(pose.T_odom_camera)
        return {"cpu_s": cpu_s, "status": str(pose.status), "T": T_odom_camera.tolist()}

    return track


def mapper(folder: Path, effort: int, settings: list[str]) -> Callable[[str], Answer]:
    """Return a function that maps the keyframe of a task, or saves the map."""
    config = MapBuilder().config
    for setting in settings:
        path, _, value = setting.partition("=")
        config = import_module("tests.bench.bench_map").changed(config, path, json.loads(value))
    builder, stamps_ns = MapBuilder(config), dict[int, int]()
    render = getattr(builder, "render_keyframe", None) or builder.shown  # type: ignore[attr-defined]

    def save(path: str) -> Answer:
        resident_mb = peak_resident_mb()
        known = sorted(k for k in stamps_ns if k in builder.views.exposures)
        np.savez(
            path,
            rows=builder.gaussians.rows,
            stamps_ns=np.array([stamps_ns[k] for k in known]),
            exposures=np.array([builder.views.exposures[k].matrix for k in known]),
        )
        iterations = int(builder.snapshot()["iterations"])
        return {
            "gaussians": builder.size(),
            "iterations": iterations,
            "resident_mb": resident_mb,
        }

    def map_keyframe(name: str) -> Answer:
        saved = np.load(folder / f"{name}.npz")
        width, height, *intrinsics = saved["camera"].tolist()
        camera = Camera(int(width), int(height), *intrinsics)
        keyframe, stamp_ns = int(saved["keyframe"]), int(saved["stamp_ns"])
        frame = RgbdFrame(saved["color"], saved["depth_m"], camera, stamp_ns, keyframe)
        mask = saved["dynamic_mask"] if saved["dynamic_mask"].size else None
        stamps_ns[keyframe] = stamp_ns
        start_s = process_time()
        builder.add(frame, saved["T_map_camera"], keyframe, effort, mask)
        render(keyframe)
        return {"cpu_s": process_time() - start_s}

    return lambda task: save(task) if task.endswith(".npz") else map_keyframe(task)


def tasks() -> Iterator[str]:
    """Yield the tasks on stdin until it ends."""
    for line in sys.stdin:
        yield line.strip()


def main() -> None:
    cv2.setNumThreads(1)
    if sys.argv[1] == "track":
        work = tracker(sys.argv[2], is_calibrating="without self-calibration" not in sys.argv[3:])
    else:
        work = mapper(Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
    for task in tasks():
        print(json.dumps(work(task)), flush=True)


if __name__ == "__main__":
    main()
