"""Mapping of recorded keyframes: CPU time per keyframe by stage, and errors on held-out frames.

    python -m tests.bench.bench_map [SOURCE ...] [--frames N] [--iterations N] [--refine N]
                                    [--set FIELD=VALUE] [--runs FOLDER]

SOURCE: data sets or synthetic sequences; default: tum/kitchen and replica/apartment_floor1 in
LDO_DATA, and synthetic:flat. The program measures like `ldo bench map`, but FIELD is a field of
`MapBuilderConfig`, such as optimizer.adam.color. Later calls use the recorded keyframes in FOLDER.
"""

import argparse
import json
import tempfile
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from ldo_service.config import load_config
from ldo_service.datasets import open_sequence
from ldo_service.gaussians.map_builder_config import MapBuilderConfig
from ldo_service.runs.map_benchmark import HeldOutErrors, TrackedSource

from .bench_map_view import default_sources


def changed(config: Any, path: str, value: Any) -> Any:
    """Return a configuration with one field, named by a dotted path, set to a value."""
    name, _, rest = path.partition(".")
    if name not in {f.name for f in fields(config)}:
        raise SystemExit(f"{type(config).__name__} has no field {name}")
    old = getattr(config, name)
    return replace(config, **{name: changed(old, rest, value) if is_dataclass(old) else value})


def report(source: str, runs: Path, arguments: argparse.Namespace, config: Any) -> None:
    tracked = TrackedSource.record(
        open_sequence(source), arguments.frames, load_config(), runs, lambda *_: None
    )
    found = tracked.measure(config, arguments.iterations, arguments.refine)
    print(
        f"{found.source} {' '.join(arguments.set)}: {found.keyframes} keyframes, "
        f"{found.iterations} iterations, {found.gaussians} Gaussians, CPU per keyframe: "
        + ", ".join(f"{stage} {ms:.0f} ms" for stage, ms in found.cpu_ms.items())
    )
    print("  online:", text_of(found.online), flush=True)
    if found.refined:
        cpu_s, errors = found.refinement_cpu_s, text_of(found.refined)
        print(f"  refined in {cpu_s:.0f} s of CPU: {errors}", flush=True)


def text_of(errors: HeldOutErrors) -> str:
    return (
        f"{errors.mean_psnr_db:.2f} ({errors.median_psnr_db:.2f}) dB, "
        f"{errors.mean_depth_l1_cm:.2f} ({errors.median_depth_l1_cm:.2f}) cm"
    )


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
            report(source, arguments.runs or Path(temporary), arguments, config)


if __name__ == "__main__":
    main()
