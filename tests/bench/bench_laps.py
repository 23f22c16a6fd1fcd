"""Time per keyframe and memory over laps of a closed trajectory; both must stay constant.

    python tests/bench/bench_laps.py [SOURCE] [--laps 10] [--stride 1] [--true-poses] [--out DIR]

The frames of SOURCE repeat, with stamps that continue from lap to lap. The program writes laps.png
and keyframes.csv, which has a line of `Mapped` for each keyframe. It prints the means and the final
values of each lap. CPU time is that of the mapper's thread with one thread of the renderer. With
--true-poses the tracker's keyframes are mapped at their true poses, so that growth cannot come from
drift.
"""

import argparse
import csv
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from ldo_service.actors.mapper import Mapper, Output
from ldo_service.actors.mapper_config import MapperConfig
from ldo_service.actors.topology import make_actors
from ldo_service.config import actor_parameters, latency_frames, load_config
from ldo_service.conversions.frames import raw_frame_to_message
from ldo_service.conversions.poses import pose_to_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.pictures import save_picture
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.runtime.stage_metrics import resident_mb
from ldo_service.schemas import (
    CameraRgbd,
    DetectionBoxes,
    GraphCorrection,
    Keyframe,
    LabelResult,
    RefineMap,
)

COLUMNS = (
    *("lap", "keyframes", "CPU ms", "resident", "offloaded", "over cap"),
    *("inserted", "pruned", "loaded", "images MB", "MB"),
)
PANEL_PX, MARGIN_PX = (900, 220), 60


@dataclass(frozen=True, slots=True)
class Mapped:
    """One keyframe in the map."""

    keyframe: int
    frame: int
    lap: int
    cpu_ms: float
    gaussians: int  # Gaussians in memory.
    offloaded: int  # Offloaded to disk.
    over_cap: int  # Gaussians in memory beyond the limit, as they may be visible.
    pruned: int  # Total since the start.
    loaded: int  # Loaded from disk since the start.
    images_mb: float  # Keyframe images in memory.
    resident_mb: float


class TimedMapper(Mapper):
    """Mapper that records the cost of each keyframe.

    It maps keyframes at T_world_camera [K, 4, 4] of the frames of a lap. Without them it uses the
    poses of tracker and optimizer.
    """

    def __init__(
        self, config: MapperConfig, frames_per_lap: int, T_world_camera: np.ndarray | None
    ) -> None:
        super().__init__(config)
        self._frames_per_lap, self._T_world_camera = frames_per_lap, T_world_camera
        self.mapped: list[Mapped] = []

    def handle(
        self, message: Keyframe | DetectionBoxes | LabelResult | GraphCorrection | RefineMap
    ) -> Iterator[Output]:
        if self._T_world_camera is not None and isinstance(message, GraphCorrection):
            return
        if not isinstance(message, Keyframe):
            yield from super().handle(message)
            return
        message = self._placed(message)
        started_s = time.thread_time()
        made = list(super().handle(message))
        self._note(message, 1e3 * (time.thread_time() - started_s))
        yield from made

    def _placed(self, keyframe: Keyframe) -> Keyframe:
        if self._T_world_camera is None:
            return keyframe
        truth = pose_to_message(self._T_world_camera[keyframe.frame % self._frames_per_lap])
        return msgspec.structs.replace(keyframe, reference=None, T_odom_keyframe=truth)

    def _note(self, keyframe: Keyframe, cpu_ms: float) -> None:
        facts = self.metrics()
        self.mapped.append(
            Mapped(
                keyframe=keyframe.keyframe,
                frame=keyframe.frame,
                lap=keyframe.frame // self._frames_per_lap,
                cpu_ms=cpu_ms,
                gaussians=int(facts["gaussians"]),
                offloaded=int(facts["gaussians_offloaded"]),
                over_cap=int(facts["gaussians_over_limit"]),
                pruned=int(facts["gaussians_pruned"]),
                loaded=int(facts["gaussians_loaded_total"]),
                images_mb=facts["keyframes_cache_mb"],
                resident_mb=resident_mb(),
            )
        )


def laps_of(sequence: Sequence, laps: int, stride: int) -> Iterator[CameraRgbd]:
    """Yield the frames of all laps; frame numbers and stamps continue from lap to lap."""
    indices = range(0, len(sequence), stride)
    stamps_ns = sequence.stamps_ns
    lap_ns = int(stamps_ns[-1] - stamps_ns[0] + stride * (stamps_ns[1] - stamps_ns[0]))
    for lap in range(laps):
        for place, index in enumerate(indices):
            raw = sequence.read(index)
            frame = lap * len(indices) + place
            raw = replace(raw, index=frame, stamp_ns=raw.stamp_ns + lap * lap_ns)
            yield raw_frame_to_message(raw, compress_depth=False)


def plot(mapped: list[Mapped]) -> np.ndarray:
    """Return an image of three curves over the keyframes."""
    columns = {
        "CPU ms per keyframe": [m.cpu_ms for m in mapped],
        "Gaussians in memory": [m.gaussians for m in mapped],
        "resident MB": [m.resident_mb for m in mapped],
    }
    ends = [i for i in range(1, len(mapped)) if mapped[i].lap != mapped[i - 1].lap]
    return np.vstack([panel(name, np.array(values), ends) for name, values in columns.items()])


def panel(name: str, values: np.ndarray, ends: list[int]) -> np.ndarray:
    width, height = PANEL_PX
    image = np.full((height, width, 3), 255, np.uint8)
    top = max(float(values.max()), 1e-9)
    x = MARGIN_PX + np.arange(len(values)) * (width - 2 * MARGIN_PX) / max(1, len(values) - 1)
    y = height - 30 - values / top * (height - 70)
    for end in ends:
        cv2.line(image, (int(x[end]), 40), (int(x[end]), height - 30), (220, 220, 220), 1)
    points = np.stack([x, y], axis=1).round().astype(np.int32)
    cv2.polylines(image, [points.reshape(-1, 1, 2)], False, (31, 111, 235), 1, cv2.LINE_AA)
    text = f"{name}: from 0 to {top:,.0f}; lines between laps"
    cv2.putText(image, text, (MARGIN_PX, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (60, 60, 60), 1)
    return image


def write(folder: Path, mapped: list[Mapped]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "keyframes.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(Mapped.__slots__)
        rows.writerows([getattr(m, name) for name in Mapped.__slots__] for m in mapped)
    save_picture(folder / "laps.png", plot(mapped))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", nargs="?", default="synthetic:flat")
    parser.add_argument("--laps", type=int, default=10)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--true-poses", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("build/laps"))
    parser.add_argument("--set", action="append", default=[])
    arguments = parser.parse_args()
    config = load_config(settings=arguments.set)
    config = replace(config, mapper=replace(config.mapper, threads=1))
    sequence = open_sequence(arguments.source)
    per_lap = len(range(0, len(sequence), arguments.stride))
    poses = true_poses(sequence)[:: arguments.stride] if arguments.true_poses else None
    parameters = actor_parameters(config)
    mapper = TimedMapper(parameters.mapper, per_lap, poses)
    actors = [mapper if actor.name == "mapper" else actor for actor in make_actors(parameters)]
    print("".join(f"{title:>10}" for title in COLUMNS))
    with LogicalClock(actors, latency_frames(config)) as clock:
        for tick in clock.run(laps_of(sequence, arguments.laps, arguments.stride)):
            if (tick + 1) % per_lap == 0:
                report(mapper.mapped, tick // per_lap)
                write(arguments.out, mapper.mapped)


def true_poses(sequence: Sequence) -> np.ndarray:
    """Return T_world_camera [len, 4, 4] of all frames."""
    truth = sequence.truth()
    if truth is None or len(truth) != len(sequence):
        raise SystemExit(
            f"{sequence.name} does not have a ground-truth pose for every frame; run without "
            "--true-poses."
        )
    return truth.T_world_camera


def report(mapped: list[Mapped], lap: int) -> None:
    """Print the row of a lap.

    `inserted`, `pruned` and `loaded` are per keyframe. Times and `MB` are means, other columns are
    values at the end of the lap.
    """
    of_lap = [m for m in mapped if m.lap == lap]
    first, last, count = mapped[mapped.index(of_lap[0]) - 1], of_lap[-1], len(of_lap)
    cpu_ms = float(np.mean([m.cpu_ms for m in of_lap]))
    made = [m.gaussians + m.offloaded + m.pruned for m in (last, first)]
    inserted = made[0] - (made[1] if lap else 0)
    pruned, loaded = last.pruned - first.pruned * (lap > 0), last.loaded - first.loaded * (lap > 0)
    per_keyframe = (f"{n / count:,.0f}" for n in (inserted, pruned, loaded))
    sizes = (f"{n:,}" for n in (last.gaussians, last.offloaded, last.over_cap))
    resident_mb = float(np.mean([m.resident_mb for m in of_lap]))
    memory = (f"{mb:.0f}" for mb in (last.images_mb, resident_mb))
    columns = (str(lap + 1), str(count), f"{cpu_ms:.0f}", *sizes, *per_keyframe, *memory)
    print("".join(f"{column:>10}" for column in columns), flush=True)


if __name__ == "__main__":
    main()
