"""Relocalization of single frames in the map of their own and of other sequences.

    OMP_NUM_THREADS=1 python tests/bench/bench_relocalization.py [SOURCE ...] [--every N]

SOURCE: data sets or synthetic sequences; default: tum/kitchen in LDO_DATA, and synthetic:flat.
Each source is tracked once, and its keyframes form its keyframe database. Every N-th frame of each
source is then searched once in each database. In the database of its own source, keyframes within
30 frames are excluded. A result is right within 10 cm and 5 degrees of the true pose between frame
and keyframe; the kitchen's ground truth has an error of 3 cm. In the map of another source every
result is false. CPU time is that of the search, with the pyramid of the frame.
"""

import argparse
import os
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.tracking import Odometry, OdometryConfig, pyramid_of
from ldo_service.tracking.keyframe_database import KeyframeDatabase, make_keyframe_record
from ldo_service.tracking.keyframes import KeyframeConfig, ReferenceKeyframe
from ldo_service.tracking.relocalization import Relocalizer
from ldo_service.tracking.tracking_quality import ResidualHistory

APART_FRAMES = 30
RIGHT_M, RIGHT_RAD = 0.10, float(np.radians(5.0))
CONFIG = OdometryConfig()
SEARCH = Relocalizer(
    CONFIG.pyramid, CONFIG.align, CONFIG.features, CONFIG.tracking_quality, CONFIG.relocalization
)


@dataclass(frozen=True)
class Mapped:
    """Sequence with its keyframe database; record ids are frame indices."""

    sequence: Sequence
    database: KeyframeDatabase
    history: ResidualHistory

    def apart_from(self, frame: int) -> KeyframeDatabase:
        return KeyframeDatabase(
            tuple(p for p in self.database.all if abs(p.id - frame) > APART_FRAMES)
        )


@dataclass
class Tally:
    """Results of searching for frames of a source among keyframes of the same or another one."""

    queries: int = 0
    errors: list[tuple[float, float]] = field(
        default_factory=list
    )  # Meters and radians; inf in the map of another source.
    times_ms: list[float] = field(default_factory=list)

    @property
    def right(self) -> int:
        return sum(m <= RIGHT_M and rad <= RIGHT_RAD for m, rad in self.errors)

    def row(self) -> str:
        p50, p95 = np.percentile(self.times_ms, [50, 95])
        distances_cm = [100 * m for m, _ in self.errors if np.isfinite(m)] or [float("nan")]
        return (
            f"{self.queries} | {len(self.errors)} | {self.right} | "
            f"{len(self.errors) - self.right} | {np.median(distances_cm):.1f} | "
            f"{max(distances_cm):.1f} | {p50:.0f} | {p95:.0f} |"
        )


def mapped(source: str) -> Mapped:
    references_only = replace(CONFIG, keyframes=KeyframeConfig(mapping_only_ratio=2.0))
    sequence, odometry, database = (
        open_sequence(source),
        Odometry(references_only),
        KeyframeDatabase(),
    )
    for frame in sequence:
        result = odometry.process(frame)
        if result.keyframe is not None:
            view = pyramid_of(frame, CONFIG.pyramid)
            keyframe = ReferenceKeyframe(view, result.T_odom_camera, frame.index)
            database = database.with_record(
                make_keyframe_record(keyframe, CONFIG.features, CONFIG.keyframe_database),
                CONFIG.keyframe_database,
            )
    return Mapped(sequence, database, ResidualHistory(**odometry.snapshot()["history"]))


def search(
    frame: RgbdFrame, database: KeyframeDatabase, turn: int, history: ResidualHistory, tally: Tally
):
    """Return the frame index of the found keyframe and T_keyframe_camera, or None."""
    start_s = time.process_time()
    found = SEARCH.find(pyramid_of(frame, CONFIG.pyramid), database, turn, history)
    tally.times_ms.append(1e3 * (time.process_time() - start_s))
    tally.queries += 1
    return None if found is None else (found[0].id, found[1].alignment.T_reference_camera)


def true_poses(sequence: Sequence) -> np.ndarray:
    """Return T_world_camera [F, 4, 4] of all frames, by the nearest stamp."""
    truth = sequence.truth()
    assert truth is not None, f"{sequence.name} has no ground truth"
    gaps_s = np.abs(truth.stamps_s[None] - 1e-9 * sequence.stamps_ns[:, None])
    return truth.T_world_camera[gaps_s.argmin(axis=1)]


def judged(query: Sequence, model: Mapped, every: int) -> Tally:
    tally, is_own = Tally(), query is model.sequence
    T_world = true_poses(query)
    for turn, index in enumerate(range(0, len(query), every)):
        database = model.apart_from(index) if is_own else model.database
        found = search(query[index], database, turn, model.history, tally)
        if found is None:
            continue
        keyframe, T_keyframe_camera = found
        error = (np.inf, np.inf)
        if is_own:
            T = se3.inverse(T_world[index]) @ T_world[keyframe] @ T_keyframe_camera
            error = float(np.linalg.norm(T[:3, 3])), se3.rotation_angle(T)
        tally.errors.append(error)
    return tally


def default_sources() -> list[str]:
    kitchen = Path(os.environ.get("LDO_DATA", "")) / "tum" / "kitchen"
    return [*([str(kitchen)] if kitchen.is_dir() else []), "synthetic:flat"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sources", nargs="*", metavar="SOURCE")
    parser.add_argument("--every", type=int, default=1)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    models = [mapped(source) for source in arguments.sources or default_sources()]
    for model in models:
        sizes = [place.nbytes for place in model.database.all]
        name, kilobytes = model.sequence.name, np.mean(sizes) / 1e3
        print(f"{name}: {len(sizes)} keyframe records of {kilobytes:.0f} kB on average")
    print("\n| frames of | in the map of | searched | found | right | false ", end="")
    print("| error cm p50 | max | CPU ms p50 | p95 |\n|" + "---|" * 10)
    for model in models:
        for other in models:
            tally = judged(other.sequence, model, arguments.every)
            print(f"| {other.sequence.name} | {model.sequence.name} | {tally.row()}", flush=True)


if __name__ == "__main__":
    main()
