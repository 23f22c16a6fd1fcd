"""Mapping of recorded keyframes: CPU time per keyframe by step, and errors on held-out frames.

    python -m tests.bench.bench_map [SOURCE ...] [--frames N] [--iterations N] [--refine N]
                                    [--set FIELD=VALUE] [--runs FOLDER]

SOURCE: data sets or synthetic sequences; default: tum/kitchen and replica/apartment_floor1 in
LDO_DATA, and synthetic:flat. Each source is tracked once by `ldo run`, into a folder of FOLDER that
later calls use again. Its keyframes are then mapped at their final poses without corrections, so
that trials with different settings differ by the mapper alone. FIELD is a field of
`MapBuilderConfig`, such as optimizer.adam.color.

The times are CPU times, also of the rendering on map/view. A row has the PSNR with interpolated
exposure and the depth L1 of the held-out frames before the last keyframe, as mean and median.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from ldo_service.conversions.frames import frame_from_message, mask_from_array
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.finished_run import Exposures, FinishedRun, PosedMap
from ldo_service.evaluation.views import view_of
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.geometry import valid_pixels
from ldo_service.recordings.mcap_file import McapIndex
from ldo_service.runs.actor_run import LAST_RATE
from ldo_service.runs.finished import read_run
from ldo_service.schemas import Keyframe, decode
from ldo_service.schemas.topics import KEYFRAME_NEW

from .bench_map_view import default_sources

REFINEMENT_RATES = 1.0, LAST_RATE  # The rates of `ldo run --refine-iterations`.


class TimedMapBuilder(MapBuilder):
    """Map builder that adds up the CPU time of densification and iterations."""

    def __init__(self, config: MapBuilderConfig) -> None:
        super().__init__(config)
        self.times_s: defaultdict[str, float] = defaultdict(float)

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        start = process_time()
        yield
        self.times_s[step] += process_time() - start

    def _insert(self, *args: Any, **kwargs: Any) -> None:
        with self.timed("densification"):
            super()._insert(*args, **kwargs)

    def _fit(self, *args: Any, **kwargs: Any) -> np.ndarray:
        with self.timed("iterations"):
            return super()._fit(*args, **kwargs)


def changed(config: Any, path: str, value: Any) -> Any:
    """Return a configuration with one field, named by a dotted path, set to a value."""
    name, _, rest = path.partition(".")
    if name not in {f.name for f in fields(config)}:
        raise SystemExit(f"{type(config).__name__} has no field {name}")
    old = getattr(config, name)
    return replace(config, **{name: changed(old, rest, value) if is_dataclass(old) else value})


def keyframes(run: Path) -> Iterator[Keyframe]:
    index = McapIndex(run / "front_end.mcap")
    for place in index.locations:
        if place.topic == KEYFRAME_NEW.name:
            yield decode(index.body(place), Keyframe)


def pose_at(run: FinishedRun, stamp_ns: int) -> np.ndarray:
    final = run.estimates["final"]
    return final.T_world_camera[int(np.abs(final.stamps_s - stamp_ns * 1e-9).argmin())]


def errors(
    builder: MapBuilder, stamps: dict[int, int], run: FinishedRun, sequence: Sequence
) -> str:
    """Return PSNR and depth L1 of the held-out frames as text."""
    known = sorted(k for k in stamps if k in builder.views.exposures)
    exposures = Exposures(
        np.array([stamps[k] for k in known]),
        np.array([builder.views.exposures[k].matrix for k in known]),
    )
    map_ = run.maps[0]
    posed = PosedMap(
        "trial", builder.gaussians.rows, map_.trajectory, exposures, None, map_.corrections
    )
    valid, found = valid_pixels(sequence.raw_camera), []
    last_ns = max(stamps.values())
    held_out = [f for f in run.frames if f.is_held_out and not f.is_lost and f.stamp_ns <= last_ns]
    for frame in held_out:
        image = sequence[frame.index]
        fits = valid is not None and valid.shape == image.depth_m.shape
        view = view_of(image, posed, frame, 1, valid if fits else None)
        rendering, measured = view.rendering, view.frame.depth_m
        seen = (measured > 0) & (rendering.opacity > 0.5)
        l1_m = np.abs(rendering.depth_m - measured)[seen].mean()
        found.append((view.psnr_db, 100 * l1_m))
    mean, median = np.mean(found, axis=0), np.median(found, axis=0)
    return f"{mean[0]:.2f} ({median[0]:.2f}) dB, {mean[1]:.2f} ({median[1]:.2f}) cm"


def recorded_run(source: str, frames: int, folder: Path) -> Path:
    """Return the folder of a run over a source with a recorded front end; make it if missing."""
    name = re.sub(r"[^A-Za-z0-9@]+", "-", source).strip("-")
    run = folder / f"{name}-{frames}"
    if not (run / "map.ply").is_file():
        options = ["--hold-out-every", "5", "--keep-front-end", "--overwrite"]
        options += ["--max-frames", str(frames), "--set", "mapper.iterations=0"]
        command = [sys.executable, "-m", "ldo_service", "run", source, "--out", str(run)]
        subprocess.run([*command, *options], check=True, stdout=subprocess.DEVNULL)
    return run


def map_keyframes(
    builder: TimedMapBuilder, run: Path, poses: FinishedRun, iterations: int
) -> dict[int, int]:
    """Map the keyframes of a run; return the stamp of each keyframe by id."""
    stamps: dict[int, int] = {}
    for message in keyframes(run):
        frame, mask = frame_from_message(message), mask_from_array(message.dynamic_mask)
        T_map_keyframe = pose_at(poses, message.stamp_ns)
        with builder.timed("all"):
            builder.add(frame, T_map_keyframe, message.keyframe, iterations, mask)
            with builder.timed("view"):
                builder.render_keyframe(message.keyframe)
        stamps[message.keyframe] = message.stamp_ns
    return stamps


def report(source: str, run: Path, arguments: argparse.Namespace, config: MapBuilderConfig) -> None:
    finished, sequence = read_run(run), open_sequence(source)
    builder = TimedMapBuilder(config)
    stamps = map_keyframes(builder, run, finished, arguments.iterations)
    mean_ms = {step: 1000 * s / len(stamps) for step, s in builder.times_s.items()}
    print(
        f"{run.name} {' '.join(arguments.set)}: {len(stamps)} keyframes, "
        f"{builder.fitting.iterations} iterations, {builder.size()} Gaussians, CPU per keyframe: "
        + ", ".join(f"{step} {ms:.0f} ms" for step, ms in mean_ms.items())
    )
    print("  online:", errors(builder, stamps, finished, sequence), flush=True)
    if arguments.refine:
        with builder.timed("refinement"):
            builder.refine(arguments.refine, REFINEMENT_RATES)
        found = errors(builder, stamps, finished, sequence)
        print(f"  refined in {builder.times_s['refinement']:.0f} s of CPU: {found}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="*", metavar="SOURCE")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--iterations", type=int, default=12, help="per keyframe")
    parser.add_argument("--refine", type=int, default=0, help="iterations after the last keyframe")
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE")
    parser.add_argument("--runs", type=Path, metavar="FOLDER")
    arguments = parser.parse_args()
    config = MapBuilderConfig()
    for setting in arguments.set:
        path, _, value = setting.partition("=")
        config = changed(config, path, json.loads(value))
    with tempfile.TemporaryDirectory() as temporary:
        for source in arguments.sources or default_sources():
            run = recorded_run(source, arguments.frames, arguments.runs or Path(temporary))
            report(source, run, arguments, config)


if __name__ == "__main__":
    main()
