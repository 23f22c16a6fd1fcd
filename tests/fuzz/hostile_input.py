"""Hostile input: headers and bodies of every outside role through mailbox, stage and actor.

    python tests/fuzz/hostile_input.py --inputs 1000000

The generators know physics: cameras, poses, depths and stamps lie at, near and beyond each bound.
The program prints inputs per second. It fails if a stage ends, or if its mailbox exceeds 256 MB.
"""

import argparse
import asyncio
import logging
import random
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent.parent))

import msgspec
import numpy as np

from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.tracker import Tracker
from ldo_service.geometry import codecs
from ldo_service.runtime.stage import Stage
from ldo_service.schemas.topics import (
    CAMERA_COLOR,
    CAMERA_DEPTH,
    CAMERA_RGBD,
    ODOMETRY_PRIOR,
    Topic,
)
from ldo_service.transport.interface import MemoryTransport
from ldo_service.transport.worker import Worker

MAX_MB = 256.0
WIDTH, HEIGHT = 64, 48
encode = msgspec.msgpack.encode

STAMPS = (0, 1, 10**9, 2**62, 2**63 - 1, 2**63, 2**64 - 1, -1)
COORDINATES = (0.0, -0.0, 1e-300, 1.0, 1e3, 9.9e7, 1e8, 1.1e8, 1e100, 1e308, float("nan"))
FOCALS = (0.0199, 0.02, 0.021, 0.5, 1.0, 99.0, 100.0, 100.1, 1e300)  # Fractions of the image side.
CENTERS = (-1.01, -1.0, -0.99, 0.0, 0.5, 1.99, 2.0, 2.01, 1e300)  # Fractions of the image side.
COEFFICIENTS = (0.0, 1e-3, 0.5, -0.5, 10.0, -10.0, 1e9, 1e12, 1e300)
DEPTHS_M = (0.0, -1.0, 1e-30, 1e-3, 2.0, 999.9, 1000.0, 1e30, 3.4e38, float("inf"), float("nan"))
SCALES = (1e-300, 1e-30, 1e-3, 1.0, 1000.0, 1e30, 1e300)
NUMBERS = (0, 1, 2, 5, 1024, 2**30, 2**62 - 1, 2**62, 2**64 - 1, -1)


@dataclass
class Generator:
    """Random messages of outside programs, from a seed."""

    random: random.Random
    stamp_ns: int = 10**9

    def header(self) -> bytes:
        """Return a header: absent, malformed, honest, or with foreign numbers."""
        pick = self.random.choice
        kind = self.random.random()
        if kind < 0.1:
            return b""
        if kind < 0.15:
            return self.random.randbytes(self.random.randrange(1, 40))
        source = pick(("camera", "", "x" * 5000, "a\n\x1b[2J"))
        return encode([source, pick((1, 2, 3, 0, 2**64 - 1)), pick(NUMBERS), self.stamp()])

    def stamp(self) -> int:
        """Return a stamp: mostly one that continues the stream, else one at or beyond a bound."""
        self.stamp_ns += self.random.choice((33_000_000, 33_000_000, 33_000_000, 0, 10**8))
        return self.stamp_ns if self.random.random() < 0.9 else self.random.choice(STAMPS)

    def odd(self, usual: Any, unusual: Sequence[Any]) -> Any:
        """Return the usual value in most cases, else an unusual one."""
        return usual if self.random.random() < 0.85 else self.random.choice(unusual)

    def camera(self) -> dict[str, Any]:
        width, height = self.odd((WIDTH, HEIGHT), ((WIDTH + 1, HEIGHT), (1, 1), (33, 32)))
        count = self.odd(0, (4, 5, 8, 3))
        return {
            "width": width,
            "height": height,
            "fx": self.odd(1.0, FOCALS) * width,
            "fy": self.odd(1.0, FOCALS) * width,
            "cx": self.odd(0.5, CENTERS) * width,
            "cy": self.odd(0.5, CENTERS) * height,
            "distortion": [self.odd(0.0, COEFFICIENTS) for _ in range(count)],
        }

    def color(self, camera: dict[str, Any]) -> dict[str, Any]:
        size = camera["width"], camera["height"]
        seed = self.random.randrange(2**32)
        pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), np.uint8)
        data = pixels.tobytes()
        encoding = self.odd("rgb8", ("bgr8", "jpeg", "png", "z16"))
        if encoding == "jpeg":
            data = codecs.encode_jpeg(pixels)
        return self.image(encoding, *size, data)

    def depth(self, camera: dict[str, Any]) -> dict[str, Any]:
        size = camera["width"], camera["height"]
        depth_m = np.full((size[1], size[0]), self.odd(2.0, DEPTHS_M), np.float32)
        depth_m[: size[1] // 3] = self.odd(1.0, DEPTHS_M)
        encoding, data = "f32", depth_m.tobytes()
        if self.random.random() < 0.3:
            encoding, data = codecs.encode_depth(depth_m)
        return self.image(self.odd(encoding, ("z16", "png", "rgb8")), *size, data)

    def image(self, encoding: str, width: int, height: int, data: bytes) -> dict[str, Any]:
        if self.random.random() < 0.03:
            data = data[: self.random.randrange(len(data) + 1)]
        return {"encoding": encoding, "width": width, "height": height, "data": data}

    def pose(self) -> list[list[float]]:
        turns = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.6, 0.8, 0.0, 0.0), (2.0, 0, 0, 0))
        return [
            [self.odd(0.1 * self.random.random(), COORDINATES) for _ in range(3)],
            list(self.odd(turns[0], turns)),
        ]

    def message(self, topic: Topic) -> bytes:
        """Return the body of a message: honest, at a bound, beyond it, or damaged."""
        kind = topic.message.__name__
        fields: dict[str, Any] = {"type": kind, "stamp_ns": self.stamp()}
        if topic is ODOMETRY_PRIOR:
            fields["T_prior_base"] = self.pose()
        else:
            camera = self.camera()
            fields |= {"frame": self.odd(1, NUMBERS), "camera": camera}
            if topic is CAMERA_RGBD:
                fields |= {"color": self.color(camera), "depth": self.depth(camera)}
            else:
                make = self.color if topic is CAMERA_COLOR else self.depth
                fields["image"] = make(camera)
            if topic is not CAMERA_COLOR:
                fields["depth_scale"] = self.odd(1.0, SCALES)
            if topic is CAMERA_DEPTH and self.random.random() < 0.5:
                fields["T_color_depth"] = self.pose()
        try:
            body = bytearray(encode(fields))
        except OverflowError:
            return b"\xc1"
        if self.random.random() < 0.05:
            body[self.random.randrange(len(body))] ^= 1 << self.random.randrange(8)
        return bytes(body)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a run: number of inputs, how they were counted, and the largest mailbox."""

    inputs: int
    handled: int
    rejected: int
    dead_letters: int
    max_mailbox_mb: float
    seconds: float


async def run(seed: int, is_over: Callable[[int, float], bool]) -> Outcome:
    """Send generated inputs to a frame source and a tracker until `is_over(inputs, seconds)`.

    Raises:
        RuntimeError: A stage has ended, or a mailbox is too large.
    """
    generator, transport = Generator(random.Random(seed)), MemoryTransport()
    stages = [Stage(FrameSource, transport), Stage(Tracker, transport)]
    tasks = [asyncio.create_task(stage.run(), name=stage.name) for stage in stages]
    await asyncio.sleep(0)
    topics = (CAMERA_RGBD, CAMERA_COLOR, CAMERA_DEPTH, ODOMETRY_PRIOR)
    inputs, peak, started_s = 0, 0.0, time.monotonic()
    while not is_over(inputs, time.monotonic() - started_s):
        topic = generator.random.choice(topics)
        transport.deliver(topic.name, generator.header(), generator.message(topic))
        inputs += 1
        if inputs % 4 == 0:
            await asyncio.sleep(0.001)  # The stages work.
            peak = max(peak, *(waiting_mb(stage) for stage in stages))
        for task in tasks:
            if task.done():
                raise RuntimeError(
                    f"seed {seed}: {task.get_name()} ended unexpectedly after {inputs} inputs"
                )
        if peak > MAX_MB:
            raise RuntimeError(
                f"seed {seed}: a mailbox holds {peak:.0f} MB, must hold at most {MAX_MB:.0f} MB"
            )
    healths = [stage.health() for stage in stages]
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    Worker.busy_workers(10.0)  # The interpreter must not end during a step.
    counts = [count for health in healths for count in health.inputs]
    return Outcome(
        inputs,
        sum(count.delivered for count in counts),
        sum(count.rejected for count in counts),
        sum(health.dead_lettered for health in healths),
        peak,
        time.monotonic() - started_s,
    )


def waiting_mb(stage: Stage) -> float:
    """Return the size of the queued messages of a stage, MB."""
    mailbox = stage._mailbox
    return sum(d.body.nbytes for d in list(mailbox._order)) / 1e6 if mailbox else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    logging.disable()
    outcome = asyncio.run(run(arguments.seed, lambda inputs, _s: inputs >= arguments.inputs))
    print(outcome)
    print(f"{outcome.inputs / outcome.seconds:.0f} inputs/s")


if __name__ == "__main__":
    main()
