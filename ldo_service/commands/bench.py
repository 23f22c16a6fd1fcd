"""Command `ldo bench`."""

import json
from dataclasses import asdict
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.table import Column, Table

from ldo_service import kernels
from ldo_service.errors import ConfigError
from ldo_service.evaluation.iteration import Iteration, bench_camera, iteration_times

from .options import argument


def bench(
    what: Annotated[
        Literal["render"],
        tyro.conf.Positional,
        argument(help="one iteration of the Gaussian optimizer: rendering, loss, gradients, Adam"),
    ],
    gaussians: Annotated[int, argument(help="Gaussians in view")] = 100_000,
    gaussians_out_of_view: Annotated[int, argument(help="additional Gaussians out of view")] = 0,
    size: Annotated[str, argument(metavar="WxH", help="size of the image, pixels")] = "640x480",
    threads: Annotated[int, argument(help="threads of the kernels")] = 1,
    repeats: Annotated[int, argument(help="iterations; the times are medians over them")] = 20,
    json_: Annotated[bool, argument(name="json", help="print one JSON object")] = False,
) -> None:
    """Measure how long one iteration of the Gaussian optimizer takes on this machine.

    The scene is synthetic. The times are medians over all repeats, in milliseconds of wall time.
    The step of Adam runs inside the backward pass: backward_ms is the time of the pass without the
    step, and adam_ms is the time that the step adds. iteration_ms is the time of forward pass,
    loss, backward pass and step together.

    Set the environment variable LDO_ISA to avx512, avx2 or baseline to choose the instruction set.
    """
    width, height = _pixels(size)
    if not min(gaussians, threads, repeats) >= 1:
        raise ConfigError(
            f"--gaussians {gaussians}, --threads {threads} and --repeats {repeats} must each be "
            "at least 1."
        )
    if gaussians_out_of_view < 0:
        raise ConfigError(f"--gaussians-out-of-view {gaussians_out_of_view} must be at least 0.")
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
        raise ConfigError(
            f"--size {size}: must be WIDTHxHEIGHT, each from 1 to 8192 pixels, such as 640x480."
        )
    if int(height) < 1:
        raise ConfigError(f"--size {size}: must be at least one pixel high.")
    return int(width), int(height)


def _table(times: dict[str, float]) -> Table:
    table = Table("step", Column("ms", justify="right"))
    for name, time_ms in times.items():
        table.add_row(name.removesuffix("_ms"), f"{time_ms:.2f}")
    return table
