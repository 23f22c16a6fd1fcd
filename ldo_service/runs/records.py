"""Records of the loop closures and the objects of a run, as JSON files.

loops.json has every loop candidate that was compared, and the loop closures.

candidates   fields of the message `loop/candidate`; rejected_reason is "" if the candidate became a
             closure, and ms is the duration of its comparison, null if it was not measured
closures     fields of `loop/closure`: keyframe, reference, T_reference_keyframe [4, 4], information
             [6, 6], overlap, rmse_m, entropy; is_believed is true if the pose graph accepted the
             closure and kept it until the end

objects.json has the objects of the map, in the map frame. The file is the message `map/objects` as
JSON. Its field `objects` is a list of entries with these fields:

    id                        constant during a run
    name, confidence          most probable class except background, and its probability
    centroid, covariance      mean position of the object's Gaussians, m, and covariance of their
                              positions, m^2 (9 numbers, row by row)
    T_map_object, size        box: center and axes (quaternion wxyz), and extents, m
    distribution              [name, probability] of each of the most probable classes
    entropy                   entropy over all classes, nats
    observation_count         keyframes that observed the object
    miss_count                keyframes that should have observed it and did not
    first_keyframe, last_keyframe   first and last keyframe that observed it
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
    """Record of loop candidates, loop closures and their acceptance."""

    def __init__(self) -> None:
        # Each candidate with the duration of the step that compared it, milliseconds. One step may
        # compare several candidates.
        self._candidates: list[tuple[LoopCandidate, float]] = []
        self._closures: list[LoopClosure] = []
        # Reference and keyframe of each closure that the pose graph rejected.
        self._rejected: set[tuple[int, int]] = set()

    def observe(
        self, message: LoopCandidate | LoopClosure | GraphCorrection, step_ms: float
    ) -> None:
        """Record one message.

        Args:
            message: Output of the loop closer or the pose-graph optimizer.
            step_ms: Duration of the step that produced the message, milliseconds.
        """
        match message:
            case GraphCorrection():
                # A correction lists only the newest rejected closures, but all accepted ones.
                self._rejected |= set(message.rejected_closures)
                self._rejected -= set(message.accepted_closures)
            case LoopClosure():
                self._closures.append(message)
            case LoopCandidate():
                self._candidates.append((message, step_ms))

    @property
    def accepted(self) -> int:
        """Number of loop closures that the pose graph accepts as of the last correction."""
        return sum(map(self._is_accepted, self._closures))

    @property
    def rejected(self) -> int:
        """Number of candidates and closures rejected by the loop closer or the pose graph."""
        refused = sum(bool(candidate.rejected_reason) for candidate, _ in self._candidates)
        return refused + len(self._closures) - self.accepted

    def _is_accepted(self, closure: LoopClosure) -> bool:
        return (closure.pose.reference, closure.pose.keyframe) not in self._rejected

    def save(self, folder: Path) -> None:
        """Write the record to a folder."""
        at_once = Counter(candidate.keyframe for candidate, _ in self._candidates)
        value = {
            "candidates": [
                _candidate(candidate, step_ms / at_once[candidate.keyframe])
                for candidate, step_ms in self._candidates
            ],
            "closures": [
                _closure(closure) | {"is_believed": self._is_accepted(closure)}
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
    """Read the loop candidates and closures of a run; return None if there is no loops.json.

    Raises:
        DataError: The file cannot be read or has an invalid format.
    """
    path = folder / LOOPS
    if not path.is_file():
        return None
    try:
        value = json.loads(path.read_text())
        return FoundLoops(
            tuple(map(_compared, value["candidates"])),
            tuple(_closed(path, row) for row in value["closures"]),
        )
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror}. Give the folder of a finished `ldo run`."
        ) from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(
            f"{path} does not have the format that `ldo run` writes ({error!r}). Give the folder "
            "of a finished `ldo run`."
        ) from error


def _compared(row: dict[str, Any]) -> ComparedPair:
    subgraphs = tuple(map(int, row["keyframes"])), tuple(map(int, row["reference_keyframes"]))
    return ComparedPair(*subgraphs, is_closure=not row["rejected_reason"], ms=row["ms"])


def _closed(path: Path, row: dict[str, Any]) -> LoopClosed:
    T = np.array(row["T_reference_keyframe"], float)
    if T.shape != (4, 4) or not np.all(np.isfinite(T)):
        raise DataError(
            f"{path}: T_reference_keyframe of keyframe {row['keyframe']} must be a 4x4 matrix of "
            "finite numbers. Repeat the run."
        )
    return LoopClosed(int(row["keyframe"]), int(row["reference"]), T)


def write_objects(folder: Path, objects: MapObjects) -> None:
    """Write objects to objects.json in a folder; equal objects give equal bytes."""
    text = msgspec.json.format(msgspec.json.encode(objects), indent=1)
    (folder / OBJECTS).write_bytes(text + b"\n")


def refuse_state(folder: Path) -> None:
    """Check that a folder is not the state folder of a service.

    Raises:
        DataError: The folder is a state folder.
    """
    if (folder / "state").is_dir():
        raise DataError(
            f"{folder} holds the state of a service, not a run. Start the service by "
            f"`ldo serve --state {folder}`. Then repeat this command with `live` instead of "
            "the folder."
        )


def read_objects(folder: Path) -> MapObjects:
    """Return the objects of a run.

    Raises:
        DataError: The folder has no objects.json, or the file has an invalid format.
    """
    path = folder / OBJECTS
    if not folder.is_dir():
        raise DataError(
            f"{folder} is not a folder. Give the folder of a finished `ldo run`, or the word "
            "`live` for a running service."
        )
    if not path.is_file():
        refuse_state(folder)
        raise DataError(
            f"{folder} has no {OBJECTS}, because the run had neither a detector nor a labeller. "
            "Repeat `ldo run` with --set detector.model=NAME; docs/detector.md shows how."
        )
    try:
        return msgspec.json.decode(path.read_bytes(), type=MapObjects)
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror}. Give the folder of a finished `ldo run`."
        ) from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(
            f"{path} does not have the format that `ldo run` writes ({error}). Give the folder of "
            "a finished `ldo run`."
        ) from error
