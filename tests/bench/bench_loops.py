"""CPU time and accuracy of loop closing.

    OMP_NUM_THREADS=1 python tests/bench/bench_loops.py [SOURCE ...] [--model FILE.onnx]
        [--stages two_stage geometric semantic]

SOURCE: data sets or synthetic sequences; default: tum/kitchen and replica/apartment_floor1 in
LDO_DATA, and synthetic:flat. The first value is the time of a query of the place database with 1000
subgraphs of random histograms. Then each source is tracked once. The loop closer gets its
keyframes, with detections if --model names a detector. CPU time is that of one core per candidate,
with pose estimation and verification. Closures are evaluated as by `ldo eval`. `retrieved` is the
number of subgraphs with a true partner among their candidates.
"""

import argparse
import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from ldo_service.actors.detector import Detector, DetectorConfig
from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.loop_closer import LoopCloser, LoopCloserConfig
from ldo_service.actors.optimizer import Optimizer
from ldo_service.actors.tracker import Tracker
from ldo_service.config import actor_parameters, latency_frames, load_config
from ldo_service.conversions.poses import pose_from_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.loops import (
    ComparedPair,
    FoundLoops,
    LoopClosed,
    LoopErrors,
    SeenKeyframe,
    evaluate_loops,
    seen_keyframes,
)
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.loop_closing import LoopsConfig
from ldo_service.loop_closing.consistency_check import ConsistencyCheckConfig, ConsistencyChecker
from ldo_service.loop_closing.object_points import LAYOUT_WORDS
from ldo_service.loop_closing.place_database import PlaceDatabase, RetrievalConfig, Stages
from ldo_service.runs.source import FrameReader, Selection
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.schemas import DetectionBoxes, GraphCorrection, Keyframe, LoopClosure, Message
from ldo_service.semantics.gaussian_labels import MAX_LABELS

SUBGRAPHS = 1000
Taken = Keyframe | DetectionBoxes | GraphCorrection  # Inputs of the loop closer.
STAGES: tuple[Stages, ...] = ("two_stage", "geometric", "semantic")


def coarse_ms(repeats: int = 20) -> float:
    """Return the median CPU time of one query among 1000 subgraphs."""
    rng = np.random.default_rng(0)
    config, poses = LoopsConfig(), KeyframePoses()
    retrieval = RetrievalConfig(count=SUBGRAPHS)
    memory = PlaceDatabase(config.words.count, "two_stage", retrieval)
    per_subgraph = config.subgraphs.max_keyframes

    def view(number: int, k: int) -> Any:
        keyframe, frame = per_subgraph * number + k, 20 * number + 3 * k
        place = SimpleNamespace(submap=0, median_depth_m=2.0)
        poses.add(keyframe, None, np.eye(4), se3.exp(rng.normal(size=6)))
        return SimpleNamespace(keyframe=keyframe, place=place, path_m=float(number), frame=frame)

    def subgraph(number: int, views: int = config.subgraphs.kept_views) -> Any:
        return SimpleNamespace(
            submap=0,
            views=[view(number, k) for k in range(views)],
            first_frame=20 * number,
            last_frame=20 * number + 15,
            names=rng.poisson(0.02, MAX_LABELS).astype(np.float32),
            layout=rng.poisson(0.05, LAYOUT_WORDS).astype(np.float32),
            words=rng.poisson(2.0, config.words.count).astype(np.float32),
        )

    for number in range(SUBGRAPHS):
        memory.add(subgraph(number))
    new, times_ms = subgraph(SUBGRAPHS + 100, per_subgraph), []
    for _ in range(repeats):
        start_s = time.process_time()
        plausible = ConsistencyChecker(poses, {}, ConsistencyCheckConfig())
        is_possible = plausible.possible_matches(
            [old.views[0] for old in memory.subgraphs], new.views[0]
        )
        motion_rad = plausible.image_motions(
            memory.subgraphs, new, is_possible, retrieval.exclude_frames
        )
        assert memory.query(new, is_possible, motion_rad)
        times_ms.append(1e3 * (time.process_time() - start_s))
    return float(np.median(times_ms))


def tracked(sequence: Sequence, model: str) -> list[Taken]:
    """Return the messages that the loop closer receives for a sequence."""
    config = load_config()
    parameters = actor_parameters(config)
    taken: list[Taken] = []
    actors = [
        FrameSource(parameters.frame_source),
        Tracker(parameters.tracker),
        Detector(DetectorConfig(model=model)),
        Optimizer(parameters.optimizer),
    ]

    def observe(_actor: str, message: Message, _ms: float) -> None:
        if isinstance(message, Taken):
            taken.append(message)

    with LogicalClock(actors, latency_frames(config), observe) as clock:
        for _ in clock.run(FrameReader(sequence, Selection().indices(sequence), print)):
            pass
    return taken


def closed(messages: list[Taken], seen: dict[int, SeenKeyframe], stages: Stages) -> LoopErrors:
    actor = LoopCloser(LoopCloserConfig(loops=LoopsConfig(stages=stages)))
    candidates, closures = [], []
    for step in (*(partial(actor.handle, message) for message in messages), actor.on_stop):
        start_s = time.process_time()
        outputs = list(step())
        ms = 1e3 * (time.process_time() - start_s)
        compared = [one for one in outputs if not isinstance(one, LoopClosure)]
        closures += [one for one in outputs if isinstance(one, LoopClosure)]
        candidates += [
            ComparedPair(
                one.keyframes, one.reference_keyframes, not one.rejected_reason, ms / len(compared)
            )
            for one in compared
        ]
    poses = [
        LoopClosed(p.keyframe, p.reference, pose_from_message(p.T_reference_keyframe))
        for p in (closure.pose for closure in closures)
    ]
    return evaluate_loops(FoundLoops(tuple(candidates), tuple(poses)), seen)


def row(errors: LoopErrors) -> str:
    def share(value: float | None) -> str:
        return "-" if value is None else f"{value:.3f}"

    p50, p95 = np.percentile(errors.ms or (0.0,), [50, 95])
    cm = 100 * np.array(errors.position_errors_m or (0.0,))
    deg = np.array(errors.rotation_errors_deg or (0.0,))
    return (
        f"{errors.candidates} | {errors.retrieved_queries} | {errors.closures} | "
        f"{share(errors.precision)} | "
        f"{errors.closed_queries} of {errors.queries} | {share(errors.recall)} | "
        f"{np.median(cm):.2f} / {cm.max():.2f} | {np.median(deg):.2f} / {deg.max():.2f} | "
        f"{p50:.0f} / {p95:.0f} |"
    )


def default_sources() -> Iterator[str]:
    for name in ("tum/kitchen", "replica/apartment_floor1"):
        folder = Path(os.environ.get("LDO_DATA", "")) / name
        if folder.is_dir():
            yield str(folder)
    yield "synthetic:flat"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sources", nargs="*", metavar="SOURCE")
    parser.add_argument("--model", default="", metavar="FILE.onnx")
    parser.add_argument("--stages", nargs="*", default=STAGES, choices=STAGES)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"place database: {coarse_ms():.2f} ms CPU per query of {SUBGRAPHS} subgraphs\n")
    print("| source | stages | candidates | retrieved | closures | precision | closed ", end="")
    print("| recall | cm p50 / max | deg p50 / max | CPU ms p50 / p95 |\n|" + "---|" * 11)
    for source in arguments.sources or default_sources():
        sequence = open_sequence(source)
        messages = tracked(sequence, arguments.model)
        frames = {m.keyframe: m.frame for m in messages if isinstance(m, Keyframe)}
        truth = sequence.truth()
        assert truth is not None, f"{sequence.name} has no ground truth"
        seen = seen_keyframes(frames, sequence, truth)
        for stages in arguments.stages:
            errors = closed(messages, seen, stages)
            print(f"| {sequence.name} | {stages} | {row(errors)}", flush=True)


if __name__ == "__main__":
    main()
