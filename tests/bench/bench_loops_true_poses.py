"""Accuracy of loop closing on true poses, without errors of tracking.

    OMP_NUM_THREADS=1 python -m tests.bench.bench_loops_true_poses [SOURCE ...] [--every N]
        [--model FILE.onnx] [--labeller NAME] [--stages two_stage geometric semantic]

SOURCE: sequences with true poses; default: `synthetic:twins`. Every N-th frame is a keyframe at its
true pose. Detections come from the detector --model; default: demo. A mapper builds the map at the
true poses, and the loop detector gets its objects after each keyframe. The labeller --labeller
names regions for the mapper; default: demo; `-` stands for none. The columns are those of
bench_loops.py.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ldo_service.actors.detector import Detector, DetectorConfig
from ldo_service.actors.mapper import Mapper
from ldo_service.actors.vlm_labeller import VlmLabeller
from ldo_service.config import actor_parameters, load_config
from ldo_service.conversions.frames import camera_to_message
from ldo_service.conversions.objects import landmarks_from_message
from ldo_service.conversions.poses import matrix6_to_message, pose_to_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.detection.detectors import NetworkConfig
from ldo_service.detection.open_networks import open_detector
from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.evaluation.loops import (
    ComparedPair,
    FoundLoops,
    LoopClosed,
    LoopErrors,
    evaluate_loops,
    seen_keyframes,
)
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.loop_closing import LoopDetector, LoopsConfig
from ldo_service.loop_closing.loop_detector import LoopCandidateResult
from ldo_service.loop_closing.object_points import DetectionPoints, locate_detections
from ldo_service.loop_closing.object_presence import MapLandmarks
from ldo_service.loop_closing.place_database import Stages
from ldo_service.schemas import (
    Array,
    DetectionBoxes,
    Keyframe,
    LabelRequest,
    LabelResult,
    MapObjects,
    Message,
)
from ldo_service.tracking.keyframe_database import KeyframeRecord, make_keyframe_record
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.pyramid import pyramid_of
from tests.bench.bench_loops import STAGES, row


@dataclass(frozen=True, eq=False, slots=True)
class Taken:
    """Inputs of the loop detector at one keyframe."""

    frame: int
    stamp_ns: int
    T_odom_keyframe: np.ndarray
    place: KeyframeRecord
    sightings: DetectionPoints


def keyframes(
    sequence: Sequence, T_world_camera: np.ndarray, every: int, model: str
) -> list[Taken]:
    """Return every `every`-th frame as a keyframe at its true pose, with the boxes of a network."""
    config, vocabulary = LoopsConfig(), Vocabulary()
    detector = open_detector(model, NetworkConfig())
    taken = []
    for index in range(0, len(sequence), every):
        frame = sequence[index]
        view = pyramid_of(frame, config.pyramid)
        T = se3.inverse(T_world_camera[0]) @ T_world_camera[index]
        ignored = np.zeros(view.levels[0].depth_m.shape, bool)
        reference = ReferenceKeyframe(view, T, len(taken), 0, ignore_mask=ignored)
        place = make_keyframe_record(reference, config.features, config.keyframe_database)
        found = detector.detect(frame.color)
        labels = [vocabulary.index(detector.labels[k]) for k in found.class_ids]
        sightings = locate_detections(
            np.array(labels, np.uint8),
            found.scores.astype(np.float32),
            found.boxes_px,
            place.depth_m,
            place.camera,
            config.verification.landmarks,
        )
        taken.append(Taken(index, int(sequence.stamps_ns[index]), T, place, sightings))
    return taken


def map_objects(
    sequence: Sequence, taken: list[Taken], model: str, labeller: str
) -> list[MapLandmarks]:
    """Return the objects of the map after each keyframe; a mapper gets the true poses.

    Args:
        sequence: The sequence.
        taken: Its keyframes.
        model: The detector.
        labeller: The labeller; "" for none.
    """
    parameters = actor_parameters(load_config())
    mapper = Mapper(parameters.mapper, has_labeller=bool(labeller))
    namer = VlmLabeller(replace(parameters.vlm_labeller, model=labeller))
    detector = Detector(DetectorConfig(model=model))
    movable = parameters.loop_closer.movable.classes
    objects, after = MapLandmarks.none(), []
    for k, one in enumerate(taken):
        frame = sequence[one.frame]
        keyframe = Keyframe(
            stamp_ns=one.stamp_ns,
            keyframe=k,
            frame=one.frame,
            camera=camera_to_message(frame.camera),
            color=Array.of(frame.color),
            depth_m=Array.of(frame.depth_m),
            reference=None,
            T_reference_keyframe=pose_to_message(np.eye(4)),
            information=matrix6_to_message(1e4 * np.eye(6)),
            T_odom_keyframe=pose_to_message(one.T_odom_keyframe),
        )
        waiting: list[Message] = [keyframe, *detector.handle(keyframe)]
        while waiting:
            message = waiting.pop(0)
            if isinstance(message, LabelRequest):
                waiting += namer.handle(message)
            elif isinstance(message, MapObjects):
                objects = landmarks_from_message(message, movable)
            elif isinstance(message, Keyframe | DetectionBoxes | LabelResult):
                waiting += mapper.handle(message)
        after.append(objects)
    return after


def found_loops(taken: list[Taken], objects: list[MapLandmarks], stages: Stages) -> FoundLoops:
    """Return the loops that the loop detector finds with one of its modes."""
    detector, poses = LoopDetector(LoopsConfig(stages=stages)), KeyframePoses()
    candidates: list[ComparedPair] = []
    closures: list[LoopClosed] = []

    def take(step: Callable[[], list[LoopCandidateResult]]) -> None:
        start_s = time.process_time()
        results = step()
        ms = 1e3 * (time.process_time() - start_s) / max(len(results), 1)
        for one in results:
            old = one.match.subgraph.keyframes
            candidates.append(ComparedPair(one.new.keyframes, old, one.closure is not None, ms))
            if one.closure:
                closures.append(LoopClosed(one.closure.b, one.closure.a, one.closure.T_a_b))

    for k, new in enumerate(taken):
        before = taken[k - 1].T_odom_keyframe if k else new.T_odom_keyframe
        step = se3.inverse(before) @ new.T_odom_keyframe
        poses.add(k, k - 1 if k else None, step, new.T_odom_keyframe, 0)
        seen = None if stages == "geometric" else new.sightings
        inputs = new.place, new.frame, new.stamp_ns, seen, poses, {}, objects[k]
        take(lambda inputs=inputs: detector.add(*inputs))
    take(lambda: detector.flush(poses, {}, objects[-1]))
    return FoundLoops(tuple(candidates), tuple(closures))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="*", metavar="SOURCE", default=["synthetic:twins"])
    parser.add_argument("--every", type=int, default=4, metavar="N")
    parser.add_argument("--model", default="demo", metavar="FILE.onnx")
    parser.add_argument("--labeller", default="demo", metavar="NAME")
    parser.add_argument("--stages", nargs="*", default=STAGES, choices=STAGES)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print("| source | stages | candidates | retrieved | closures | precision | closed ", end="")
    print("| recall | cm p50 / max | deg p50 / max | CPU ms p50 / p95 |\n|" + "---|" * 11)
    for source in arguments.sources:
        sequence = open_sequence(source)
        truth = sequence.truth()
        assert truth is not None, f"{sequence.name} has no ground truth"
        taken = keyframes(sequence, truth.T_world_camera, arguments.every, arguments.model)
        labeller = arguments.labeller.strip("-")
        objects = map_objects(sequence, taken, arguments.model, labeller)
        frames = {k: one.frame for k, one in enumerate(taken)}
        seen = seen_keyframes(frames, sequence, truth)
        for stages in arguments.stages:
            errors: LoopErrors = evaluate_loops(found_loops(taken, objects, stages), seen)
            print(f"| {sequence.name} | {stages} | {row(errors)}", flush=True)


if __name__ == "__main__":
    main()
