"""Held-out errors against the CPU time of the mapper, compared with those of another checkout.

    python -m tests.bench.bench_map_curves [SOURCE ...] [--other CHECKOUT] [--frames N]
                                           [--efforts N ...] [--set FIELD=VALUE ...] [--seed N]
                                           [--runs FOLDER] [--plots FOLDER]

SOURCE: data sets or synthetic sequences; default: tum/kitchen and replica/apartment_floor1 in
LDO_DATA, and synthetic:flat. CHECKOUT has its environment in .venv, and the code of commit 18f9264
or later. Each mapper and each effort is a process of its own with one thread. Each of them maps a
keyframe before the first one maps the next keyframe, so other load affects all equally. All map the
keyframes that this checkout has tracked, at their final poses. This checkout evaluates all maps.

With --set, this checkout also maps with other values of fields of `MapBuilderConfig`, as in
`bench_map.py`. --seed sets the seed of this checkout. The plots show the mean PSNR against the CPU
time per keyframe. The last lines give the CPU time, relative to the first variant with the highest
effort, at which the curve of another variant reaches its PSNR.
"""

import argparse
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ldo_service.config import load_config
from ldo_service.conversions.frames import frame_from_message, mask_from_array
from ldo_service.datasets import open_sequence
from ldo_service.evaluation.finished_run import Exposures
from ldo_service.runs.map_benchmark import HeldOutErrors, TrackedSource

from .bench_map import text_of
from .bench_map_view import default_sources
from .checkouts import turn, workers

HEADER = """\
| source, keyframes | mapper | effort | ms per keyframe | ratio | iterations | Gaussians | MB \
| PSNR dB | depth L1 cm |
|---|---|---|---|---|---|---|---|---|---|"""
# Sizes of a plot in pixels: width, height, and margins at the left and at the bottom.
WIDTH, HEIGHT, LEFT, BOTTOM = 460, 300, 56, 44
COLORS = "#1f6feb", "#d1495b", "#2e7d32"


@dataclass(frozen=True, slots=True)
class Variant:
    """Mapper of one checkout, with values of fields of its `MapBuilderConfig`."""

    name: str
    checkout: Path | None
    settings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Point:
    """Map of one variant with one effort."""

    variant: str
    effort: int
    cpu_ms: float  # CPU time per keyframe, milliseconds.
    iterations: int
    gaussians: int
    resident_mb: float  # Peak of the process.
    errors: HeldOutErrors


def save_keyframes(tracked: TrackedSource, folder: Path) -> Iterator[str]:
    """Save each keyframe for the workers, and yield its name."""
    for message in tracked.keyframes():
        frame, mask = frame_from_message(message), mask_from_array(message.dynamic_mask)
        camera = frame.camera
        name = f"{message.keyframe:06}"
        np.savez(
            folder / f"{name}.npz",
            color=frame.color,
            depth_m=frame.depth_m,
            camera=[camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy],
            T_map_camera=tracked.final_pose(message.stamp_ns),
            keyframe=message.keyframe,
            stamp_ns=message.stamp_ns,
            dynamic_mask=np.zeros((0, 0), bool) if mask is None else mask,
        )
        yield name


def variants(arguments: argparse.Namespace) -> list[Variant]:
    """Return the mappers to compare; the ratios are relative to the first one."""
    seed = (f"seed={arguments.seed}",)
    compared = [Variant("this one", None, seed)]
    if arguments.other:
        compared.insert(0, Variant(arguments.other.name, arguments.other))
    if arguments.set:
        compared.append(Variant(" ".join(arguments.set), None, (*seed, *arguments.set)))
    return compared


def measure(
    tracked: TrackedSource, compared: list[Variant], efforts: list[int], folder: Path
) -> list[Point]:
    """Map the keyframes with each variant and each effort, and evaluate the maps."""
    places = [(variant, effort) for variant in compared for effort in efforts]
    tasks = [
        (variant.checkout, ("map", str(folder), str(effort), *variant.settings))
        for variant, effort in places
    ]
    cpu_s, names = np.zeros(len(places)), [*save_keyframes(tracked, folder)]
    points = []
    with workers(tasks) as started:
        for number, name in enumerate(names):
            cpu_s += [answer["cpu_s"] for answer in turn(started, number, name)]
        for (variant, effort), worker, spent_s in zip(places, started, cpu_s, strict=True):
            answer = worker.run(str(folder / "map.npz"))
            saved = np.load(folder / "map.npz")
            exposures = Exposures(saved["stamps_ns"], saved["exposures"])
            last_ns = int(saved["stamps_ns"].max())
            errors = tracked.held_out_errors(saved["rows"], exposures, last_ns)
            cpu_ms = 1000 * float(spent_s) / len(names)
            points.append(Point(variant.name, effort, cpu_ms, errors=errors, **answer))
    return points


def rows_of(source: str, points: list[Point], reference_ms: float) -> Iterator[str]:
    """Yield the rows of the table; ratios are relative to `reference_ms`."""
    for point in points:
        yield (
            (
                f"| {source} | {point.variant} | {point.effort} | {point.cpu_ms:.0f} | "
                f"{point.cpu_ms / reference_ms:.2f} | {point.iterations} | {point.gaussians:,} | "
                f"{point.resident_mb:.0f} | {text_of(point.errors).replace(', ', ' | ')} |"
            )
            .replace(" dB", "")
            .replace(" cm |", " |")
        )


def cpu_ms_at(points: list[Point], psnr_db: float) -> float | None:
    """Return the CPU time at which the curve of some points first reaches a PSNR.

    Args:
        points: Points of one checkout, by ascending effort.
        psnr_db: The mean PSNR.

    Returns:
        Milliseconds per keyframe, interpolated linearly; those of the first point if it exceeds the
        PSNR; None if no point reaches it.
    """
    if points[0].errors.mean_psnr_db >= psnr_db:
        return points[0].cpu_ms
    for before, after in pairwise(points):
        below, above = before.errors.mean_psnr_db, after.errors.mean_psnr_db
        if below < psnr_db <= above:
            share = (psnr_db - below) / (above - below)
            return before.cpu_ms + share * (after.cpu_ms - before.cpu_ms)
    return None


def plot(title: str, curves: dict[str, list[Point]]) -> str:
    """Return an SVG with the PSNR against the CPU time; a number at each point is its effort."""
    points = [point for curve in curves.values() for point in curve]
    psnr_db = [point.errors.mean_psnr_db for point in points]
    low_db, high_db = np.floor(min(psnr_db)), np.ceil(max(psnr_db))
    end_ms = 200 * np.ceil(max(point.cpu_ms for point in points) / 200)

    def place(cpu_ms: float, value_db: float) -> tuple[float, float]:
        x = LEFT + cpu_ms / end_ms * (WIDTH - LEFT - 20)
        y = HEIGHT - BOTTOM - (value_db - low_db) / (high_db - low_db) * (HEIGHT - BOTTOM - 40)
        return round(float(x), 1), round(float(y), 1)

    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" '
        'font-family="sans-serif" font-size="12">',
        '<rect width="100%" height="100%" fill="#ffffff"/>',
        text(WIDTH / 2, 20, title),
        text(WIDTH / 2, HEIGHT - 8, "CPU ms per keyframe"),
        f'<g transform="rotate(-90 14 {HEIGHT / 2})">{text(14, HEIGHT / 2, "PSNR dB")}</g>',
    ]
    for value_db in np.arange(low_db, high_db + 0.5):
        (x, y), (end, _) = place(0, value_db), place(end_ms, value_db)
        lines.append(f'<line x1="{x}" y1="{y}" x2="{end}" y2="{y}" stroke="#ddd"/>')
        lines.append(text(x - 16, y + 4, f"{value_db:.0f}"))
    for cpu_ms in np.linspace(0, end_ms, 5):
        x, y = place(cpu_ms, low_db)
        lines.append(text(x, y + 16, f"{cpu_ms:.0f}"))
    for color, (name, curve) in zip(COLORS, curves.items(), strict=False):
        places = [place(point.cpu_ms, point.errors.mean_psnr_db) for point in curve]
        path = " ".join(f"{x},{y}" for x, y in places)
        lines.append(f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2"/>')
        for (x, y), point in zip(places, curve, strict=True):
            lines.append(f'<circle cx="{x}" cy="{y}" r="3" fill="{color}"/>')
            lines.append(text(x, y - 7, str(point.effort), color))
        y = HEIGHT - BOTTOM - 12 - 16 * COLORS.index(color)
        lines.append(text(WIDTH - 24, y, name, color, "end"))
    return "\n".join([*lines, "</svg>\n"])


def text(x: float, y: float, content: str, color: str = "#223", anchor: str = "middle") -> str:
    place = f'x="{x:g}" y="{y:g}" text-anchor="{anchor}"'
    return f'<text {place} fill="{color}">{content}</text>'


def report(source: str, runs: Path, arguments: argparse.Namespace) -> None:
    tracked = TrackedSource.record(
        open_sequence(source), arguments.frames, load_config(), runs, lambda *_: None
    )
    compared = variants(arguments)
    with tempfile.TemporaryDirectory() as folder:
        points = measure(tracked, compared, sorted(arguments.efforts), Path(folder))
    curves = {
        variant.name: [point for point in points if point.variant == variant.name]
        for variant in compared
    }
    reference = next(iter(curves.values()))[-1]
    name = tracked.sequence.name
    print(*rows_of(f"{name}, {len(tracked.run.keyframes)}", points, reference.cpu_ms), sep="\n")
    for variant in compared[1:]:
        cpu_ms = cpu_ms_at(curves[variant.name], reference.errors.mean_psnr_db)
        found = "not reached" if cpu_ms is None else f"at {cpu_ms / reference.cpu_ms:.2f} times"
        print(f"{name}, {variant.name}: PSNR of {reference.variant} {found}", flush=True)
    if arguments.plots:
        file = "map-" + re.sub(r"[^A-Za-z0-9]+", "-", name) + ".svg"
        (arguments.plots / file).write_text(plot(name, curves))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="*", metavar="SOURCE")
    parser.add_argument("--other", type=Path, metavar="CHECKOUT")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--efforts", type=int, nargs="+", default=[2, 4, 8, 12])
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=Path, metavar="FOLDER")
    parser.add_argument("--plots", type=Path, metavar="FOLDER")
    arguments = parser.parse_args()
    print(HEADER, flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        for source in arguments.sources or default_sources():
            report(source, arguments.runs or Path(temporary), arguments)


if __name__ == "__main__":
    main()
