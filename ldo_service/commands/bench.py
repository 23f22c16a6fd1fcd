"""ldo bench"""

import json
from dataclasses import asdict
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.table import Column, Table

from ldo_service import kernels
from ldo_service.errors import ConfigError
from ldo_service.evaluation.iteration import Iteration, bench_camera, iteration_times


def bench(
    what: Annotated[
        Literal["render"],
        tyro.conf.Positional,
        tyro.conf.arg(help="an iteration of the optimiser: rendering, loss, gradients, Adam"),
    ],
    gaussians: Annotated[int, tyro.conf.arg(help="in view")] = 100_000,
    gaussians_out_of_view: Annotated[int, tyro.conf.arg(help="Gaussians more, out of view")] = 0,
    size: Annotated[str, tyro.conf.arg(metavar="WxH", help="of the image, pixels")] = "640x480",
    threads: Annotated[int, tyro.conf.arg(help="of the kernels")] = 1,
    repeats: Annotated[int, tyro.conf.arg(help="that the medians are taken of")] = 20,
    json_: Annotated[bool, tyro.conf.arg(name="json", help="print one JSON object")] = False,
) -> None:
    """Measure how long an iteration takes on this machine.

    Medians over repeats on a made-up scene, in milliseconds of wall time. Adam is a part of the
    backward pass: adam_ms is what it adds, the pass with it less the pass without, and iteration_ms
    is forward, loss and the pass with it. LDO_ISA=avx512, avx2 or baseline picks the instructions.
    """
    width, height = _pixels(size)
    if not min(gaussians, threads, repeats) >= 1 or gaussians_out_of_view < 0:
        raise ConfigError(
            "gaussians, threads and repeats must be 1 or more, gaussians-out-of-view 0 or more."
        )
    camera = bench_camera(width, height)
    iteration = Iteration(gaussians, camera, threads=threads, elsewhere=gaussians_out_of_view)
    times = asdict(iteration_times(iteration, repeats))
    facts = {
        "isa": kernels.isa(),
        "gaussians": gaussians,
        "gaussians_out_of_view": gaussians_out_of_view,
        "width": width,
        "height": height,
        "threads": threads,
    }
    if json_:
        print(json.dumps(times | facts))
    else:
        console = Console(highlight=False)
        console.print(f"{what}: " + ", ".join(f"{name} {fact}" for name, fact in facts.items()))
        console.print(_table(times))


def _pixels(size: str) -> tuple[int, int]:
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal() and 1 <= int(width) <= 8192 >= int(height)):
        raise ConfigError(f"--size {size}: must be WIDTHxHEIGHT in pixels, as 640x480.")
    if int(height) < 1:
        raise ConfigError(f"--size {size}: must be at least one pixel high.")
    return int(width), int(height)


def _table(times: dict[str, float]) -> Table:
    table = Table("step", Column("ms", justify="right"))
    for name, time_ms in times.items():
        table.add_row(name.removesuffix("_ms"), f"{time_ms:.2f}")
    return table
