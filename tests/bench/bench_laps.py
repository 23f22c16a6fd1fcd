"""Time per keyframe and memory over laps of a closed walk: both must stay flat.

    python tests/bench/bench_laps.py [SOURCE] [--laps 10] [--stride 1] [--out DIR]

Every frame of SOURCE again and again, with stamps that go on. Writes keyframes.csv (keyframe,
frame, lap, CPU ms of the mapper, Gaussians awake and asleep, resident MB) and laps.png, and prints
the mean of each lap. CPU time is that of the mapper's thread with one thread of the renderer.
"""

import argparse
import csv
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from ldo_service.actors.graph import make_actors
from ldo_service.actors.mapper import Mapper
from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.evaluation.pictures import save_picture
from ldo_service.recordings.sequence import open_source
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.runtime.vitals import resident_mb
from ldo_service.schemas import CameraRgbd, Keyframe, Message
from ldo_service.wire import camera_rgbd_message

PANEL_PX, MARGIN_PX = (900, 220), 60


@dataclass(frozen=True, slots=True)
class Mapped:
    """One keyframe in the map."""

    keyframe: int
    frame: int
    lap: int
    cpu_ms: float
    gaussians: int
    asleep: int
    resident_mb: float


class TimedMapper(Mapper):
    """A mapper that notes what each keyframe cost."""

    def __init__(self, *args: object, frames_per_lap: int) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self._frames_per_lap = frames_per_lap
        self.mapped: list[Mapped] = []

    def handle(self, message: object) -> Iterator[Message]:
        started_s = time.thread_time()
        made = list(super().handle(message))  # type: ignore[arg-type]
        if isinstance(message, Keyframe):
            facts = self.facts()
            self.mapped.append(
                Mapped(
                    message.keyframe,
                    message.frame,
                    message.frame // self._frames_per_lap,
                    1e3 * (time.thread_time() - started_s),
                    int(facts["gaussians"]),
                    int(facts["gaussians_asleep"]),
                    resident_mb(),
                )
            )
        yield from made


def laps_of(sequence: Sequence, laps: int, stride: int) -> Iterator[CameraRgbd]:
    """Frames and stamps go on from lap to lap."""
    indices = range(0, len(sequence), stride)
    stamps_ns = sequence.stamps_ns
    lap_ns = int(stamps_ns[-1] - stamps_ns[0] + stride * (stamps_ns[1] - stamps_ns[0]))
    for lap in range(laps):
        for place, index in enumerate(indices):
            raw = sequence.read(index)
            frame = lap * len(indices) + place
            raw = replace(raw, index=frame, stamp_ns=raw.stamp_ns + lap * lap_ns)
            yield camera_rgbd_message(raw, compress_depth=False)


def plot(mapped: list[Mapped]) -> np.ndarray:
    """Three panels over the keyframes."""
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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", nargs="?", default="synthetic:flat")
    parser.add_argument("--laps", type=int, default=10)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("build/laps"))
    parser.add_argument("--set", action="append", default=[])
    arguments = parser.parse_args()
    config = load_config(settings=arguments.set)
    config = replace(config, mapper=replace(config.mapper, threads=1))
    sequence = open_source(arguments.source)
    per_lap = len(range(0, len(sequence), arguments.stride))
    mapper = TimedMapper(config.mapper, frames_per_lap=per_lap)
    actors = [mapper if actor.name == "mapper" else actor for actor in make_actors(config)]
    print(f"{'lap':>4} {'keyframes':>10} {'CPU ms':>8} {'Gaussians':>10} {'asleep':>10} {'MB':>7}")
    with LogicalClock(actors, config.run.latency_frames()) as clock:
        for tick in clock.run(laps_of(sequence, arguments.laps, arguments.stride)):
            if (tick + 1) % per_lap == 0:
                report(mapper.mapped, tick // per_lap)
                write(arguments.out, mapper.mapped)


def report(mapped: list[Mapped], lap: int) -> None:
    of_lap = [m for m in mapped if m.lap == lap]
    last = of_lap[-1]
    cpu_ms = float(np.mean([m.cpu_ms for m in of_lap]))
    print(
        f"{lap + 1:>4} {len(of_lap):>10} {cpu_ms:>8.0f} {last.gaussians:>10,} {last.asleep:>10,} "
        f"{last.resident_mb:>7.0f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
