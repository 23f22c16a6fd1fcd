"""Records of a run: its loops and objects as JSON.

loops.json holds every pair of places that was compared, and the loops that were closed.

candidates   as the message `loop/candidate`: keyframe, reference, keyframes, references,
             similarity, appearance, evidence, inliers, divergence, entropy, overlap, rmse_m, and
             refused, which is "" where it became a closure; ms is the time of its comparison, null
             where it was not measured
closures     as `loop/closure`: keyframe, reference, T_reference_keyframe [4, 4], information
             [6, 6], overlap, rmse_m, entropy; and is_believed, whether the graph took it, and
             still did at the end

objects.json holds the objects of its map, in the map's frame.

It is the message `map/objects` as it is on the network, in JSON: `objects` is a list of

    id, name, confidence      stays what it is during a run; the likeliest class, 0..1
    centroid, covariance      of the Gaussians, m, and m^2 (9 numbers, row by row)
    T_map_object, size        of the box: its centre, its axes (quaternion wxyz), and extents, m
    distribution, entropy     [name, probability] of the likeliest classes; nats
    seen, missed              keyframes that saw it, and that ought to have
    first_keyframe, last_keyframe   that saw it
    views                     keyframes that show it best, with box_px
"""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ldo_service.conversions.poses import pose_from_message
from ldo_service.errors import DataError
from ldo_service.evaluation.loops import ComparedPair, FoundLoops, LoopClosed
from ldo_service.schemas import GraphCorrection, LoopCandidate, LoopClosure, MapObjects

LOOPS = "loops.json"

OBJECTS = "objects.json"


class LoopRecord:
    """Takes note of what the loop closer says."""

    def __init__(self) -> None:
        self._candidates: list[tuple[LoopCandidate, float]] = []  # with ms of their whole step
        self._closures: list[LoopClosure] = []
        self._not_believed: set[tuple[int, int]] = set()  # reference and keyframe

    def observe(
        self, message: LoopCandidate | LoopClosure | GraphCorrection, step_ms: float
    ) -> None:
        match message:
            case GraphCorrection():
                # a correction names the newest of them, and all that came to be believed again
                self._not_believed |= set(message.rejected_closures)
                self._not_believed -= set(message.accepted_closures)
            case LoopClosure():
                self._closures.append(message)
            case LoopCandidate():
                self._candidates.append((message, step_ms))

    @property
    def accepted(self) -> int:
        """By the graph."""
        return sum(map(self._is_believed, self._closures))

    @property
    def rejected(self) -> int:
        """By the loop closer, or by the graph."""
        refused = sum(bool(candidate.rejected_reason) for candidate, _ in self._candidates)
        return refused + len(self._closures) - self.accepted

    def _is_believed(self, closure: LoopClosure) -> bool:
        return (closure.pose.reference, closure.pose.keyframe) not in self._not_believed

    def save(self, folder: Path) -> None:
        at_once = Counter(candidate.keyframe for candidate, _ in self._candidates)
        value = {
            "candidates": [
                _candidate(candidate, step_ms / at_once[candidate.keyframe])
                for candidate, step_ms in self._candidates
            ],
            "closures": [
                _closure(closure) | {"is_believed": self._is_believed(closure)}
                for closure in self._closures
            ],
        }
        (folder / LOOPS).write_text(json.dumps(value, indent=1) + "\n")


def _candidate(message: LoopCandidate, ms: float) -> dict[str, Any]:
    fields = msgspec.to_builtins(message)
    return {
        **{name: value for name, value in fields.items() if name not in ("type", "stamp_ns")},
        "stamp_ns": message.stamp_ns,
        "ms": round(ms, 3) if ms else None,
    }


def _closure(message: LoopClosure) -> dict[str, Any]:
    return {
        "keyframe": message.pose.keyframe,
        "reference": message.pose.reference,
        "T_reference_keyframe": pose_from_message(message.pose.T_reference_keyframe).tolist(),
        "information": np.reshape(message.pose.information, (6, 6)).tolist(),
        "overlap": message.overlap,
        "rmse_m": message.rmse_m,
        "entropy": message.entropy,
    }


def read_loops(folder: Path) -> FoundLoops | None:
    """None where the run wrote none; raises DataError where it is not what a run writes."""
    path = folder / LOOPS
    if not path.is_file():
        return None
    try:
        value = json.loads(path.read_text())
        return FoundLoops(
            tuple(map(_compared, value["candidates"])), tuple(map(_closed, value["closures"]))
        )
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}.") from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"{path} is not what `ldo run` writes: {error!r}.") from error


def _compared(row: dict[str, Any]) -> ComparedPair:
    subgraphs = tuple(map(int, row["keyframes"])), tuple(map(int, row["reference_keyframes"]))
    return ComparedPair(*subgraphs, is_closure=not row["rejected_reason"], ms=row["ms"])


def _closed(row: dict[str, Any]) -> LoopClosed:
    T = np.array(row["T_reference_keyframe"], float)
    if T.shape != (4, 4) or not np.all(np.isfinite(T)):
        raise ValueError(f"T_reference_keyframe of {row['keyframe']} is no finite 4x4 matrix")
    return LoopClosed(int(row["keyframe"]), int(row["reference"]), T)


def write_objects(folder: Path, objects: MapObjects) -> None:
    """The same objects give the same bytes."""
    text = msgspec.json.format(msgspec.json.encode(objects), indent=1)
    (folder / OBJECTS).write_bytes(text + b"\n")


def refuse_state(folder: Path) -> None:
    """Raises DataError for a folder where a service keeps its state."""
    if (folder / "state").is_dir():
        raise DataError(
            f"{folder} holds the state of a service, and nothing that `ldo run` writes: "
            f"`ldo serve --resume {folder}` goes on with it, and `live` names that service here."
        )


def read_objects(folder: Path) -> MapObjects:
    """Raises DataError when there is no such file, or it is not what `write_objects` writes."""
    path = folder / OBJECTS
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder: name that of a finished `ldo run`, or `live`.")
    if not path.is_file():
        refuse_state(folder)
        raise DataError(
            f"{folder} has no {OBJECTS}: the run kept no objects, which takes a detector. "
            "`ldo run` the sequence again with detector.model set; `ldo models` tells how."
        )
    try:
        return msgspec.json.decode(path.read_bytes(), type=MapObjects)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}.") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"{path} is not what `ldo run` writes: {error}.") from error
