"""Hostile input: headers and bodies of every outside role through mailbox, stage and actor.

    python tests/fuzz/hostile_input.py --inputs 1000000
    python tests/fuzz/hostile_input.py --minutes 1

The generators know physics: cameras, poses, depths and stamps lie at, near and beyond each bound.
The roles are camera, odometry and operator. The stages are the frame source, the tracker, the
mapper, the loop closer, the optimizer and the labeller. `Control` pauses, resumes, saves and resets
them.

The program prints inputs per second, and each failure with its traceback, seed and input. Its exit
code is 1 if a stage ends, a step or a heartbeat fails, or the queued messages of all stages exceed
256 MB. If Python runs with `-W error`, a warning of NumPy about an invalid number is a failure too.
"""

import argparse
import asyncio
import logging
import random
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent.parent))

import msgspec
import numpy as np

from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.loop_closer import LoopCloser
from ldo_service.actors.mapper import Mapper
from ldo_service.actors.mapper_config import MapperConfig
from ldo_service.actors.optimizer import Optimizer
from ldo_service.actors.tracker import Tracker
from ldo_service.actors.vlm_labeller import VlmLabeller
from ldo_service.detection.labellers.chat_completion import HttpLabeller
from ldo_service.gaussians.loop_refit import LoopRefitConfig
from ldo_service.geometry import codecs
from ldo_service.runtime import Actor
from ldo_service.runtime.actor_graph import lossless_consumers
from ldo_service.runtime.control import Control
from ldo_service.runtime.restoring import FailureLog
from ldo_service.runtime.stage import Stage
from ldo_service.runtime.supervision_policy import SupervisionConfig
from ldo_service.schemas import ControlAnswer, decode
from ldo_service.schemas.topics import (
    CAMERA_COLOR,
    CAMERA_DEPTH,
    CAMERA_RGBD,
    CONTROL,
    LABEL_ADD,
    MAP_REFINE,
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
ITERATIONS = (0, 1, 3, -1, 2**31, 2**63 - 1, 2**64 - 1, 1.5)  # The mapper runs valid numbers.
RATES = (1.0, 0.5, 1e-300, 5e-324, 0.0, -1.0, 1.1, 1e300, float("inf"), float("nan"))
NAMES = (
    "chair",
    "a" * 100,
    "a" * 101,
    "",
    " ",
    "\x1b[2J\n",
    "\u202e\0",
    " " * 50_000,
    "\U0001f4a9",
)
COMMANDS = ("save", "pause", "resume", "reset", "", "RESET", "x" * 5000, "\x1b[2J\n")

# Fractions of unusual values. Each applies to 100 inputs; among few unusual values, the tracker
# follows the camera, and the mapper gets keyframes of slightly unusual frames.
RATIOS = (0.005, 0.02, 0.15, 0.5)
INPUTS_PER_RATIO = 100
SETTLED_WITHIN_S = 60.0  # The service ends a step after the same time.
TOPICS = {
    CAMERA_RGBD: 40,
    CAMERA_COLOR: 20,
    CAMERA_DEPTH: 20,
    ODOMETRY_PRIOR: 20,
    LABEL_ADD: 4,
    MAP_REFINE: 2,
    CONTROL: 1,
}


@dataclass
class Generator:
    """Random messages of outside programs, from a seed."""

    random: random.Random
    stamp_ns: int = 10**9
    ratio: float = 0.15  # Fraction of unusual values.
    made: int = 0
    scene_xy: tuple[int, int] = (100, 100)  # Position of the camera over the scene, pixels.

    def __post_init__(self) -> None:
        noise = np.random.default_rng(self.random.randrange(2**32))
        coarse = noise.uniform(0, 255, (40, 40, 3))
        self.scene = np.kron(coarse, np.ones((8, 8, 1)))  # [320, 320, 3], of flat squares.

    def next_input(self) -> tuple[Topic, bytes, bytes]:
        """Return topic, header and body of an input."""
        if self.made % INPUTS_PER_RATIO == 0:
            self.ratio = self.random.choice(RATIOS)
        self.made += 1
        (topic,) = self.random.choices([*TOPICS], [*TOPICS.values()])
        return topic, self.header(), self.message(topic)

    def header(self) -> bytes:
        """Return a header: absent, malformed, honest, or with foreign numbers."""
        pick = self.random.choice
        if self.random.random() > self.ratio:
            return b""
        if self.random.random() < 0.3:
            return self.random.randbytes(self.random.randrange(1, 40))
        source = pick(("camera", "", "x" * 5000, "a\n\x1b[2J"))
        return encode([source, pick((1, 2, 3, 0, 2**64 - 1)), pick(NUMBERS), self.stamp()])

    def stamp(self) -> int:
        """Return a stamp: mostly one that continues the stream, else one at or beyond a bound."""
        self.stamp_ns += self.random.choice((33_000_000, 33_000_000, 33_000_000, 0, 10**8))
        return self.odd(self.stamp_ns, STAMPS)

    def odd(self, usual: Any, unusual: Sequence[Any]) -> Any:
        """Return the usual value in most cases, else an unusual one."""
        return usual if self.random.random() >= self.ratio else self.random.choice(unusual)

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
        pixels = self.view(*size)
        if self.random.random() < self.ratio:
            pixels = self.noise().integers(0, 255, pixels.shape, np.uint8)
        data = pixels.tobytes()
        encoding = self.odd("rgb8", ("bgr8", "jpeg", "png", "z16"))
        if encoding == "jpeg":
            data = codecs.encode_jpeg(pixels)
        return self.image(encoding, *size, data)

    def noise(self) -> np.random.Generator:
        return np.random.default_rng(self.random.randrange(2**32))

    def view(self, width: int, height: int) -> np.ndarray:
        """Return what the camera sees of the scene, [H, W, 3] uint8."""
        x, y = self.scene_xy
        return self.scene[y : y + height, x : x + width].astype(np.uint8)

    def move(self) -> None:
        """Move the camera by up to two pixels."""
        steps = (self.random.choice((-1, 0, 1, 2)) for _ in range(2))
        x, y = (at + step for at, step in zip(self.scene_xy, steps, strict=True))
        self.scene_xy = x % 250, y % 250

    def depth(self, camera: dict[str, Any]) -> dict[str, Any]:
        size = camera["width"], camera["height"]
        relief = self.view(*size)[:, :, 0].astype(np.float32) / 500  # Half a meter at most.
        depth_m = relief + np.float32(self.odd(2.0, DEPTHS_M))
        if self.random.random() < self.ratio:
            depth_m[: size[1] // 3] = self.random.choice(DEPTHS_M)
        if self.random.random() < 0.3:  # Single pixels, as of a simulator.
            pixels = self.noise().integers(0, depth_m.size, 5)
            depth_m.flat[pixels] = self.random.choice(DEPTHS_M)
        encoding, data = "f32", depth_m.tobytes()
        if self.random.random() < 0.3:
            with np.errstate(all="ignore"):
                encoding, data = codecs.encode_depth(depth_m)
        return self.image(self.odd(encoding, ("z16", "png", "rgb8")), *size, data)

    def image(self, encoding: str, width: int, height: int, data: bytes) -> dict[str, Any]:
        if self.random.random() < self.ratio / 5:
            data = data[: self.random.randrange(len(data) + 1)]
        return {"encoding": encoding, "width": width, "height": height, "data": data}

    def pose(self) -> dict[str, list[float]]:
        turns = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.6, 0.8, 0.0, 0.0), (2.0, 0, 0, 0))
        near = [0.1 * self.random.random() for _ in range(3)]
        return {
            "translation": [self.odd(at, COORDINATES) for at in near],
            "quaternion": list(self.odd(turns[0], turns)),
        }

    def message(self, topic: Topic, unknown_bytes: int = 0) -> bytes:
        """Return the body of a message: honest, at a bound, beyond it, or damaged.

        Args:
            topic: The topic.
            unknown_bytes: Size of a further field that the message type does not have.
        """
        kind = topic.message.__name__
        fields: dict[str, Any] = {"type": kind, "stamp_ns": self.stamp()}
        if topic is ODOMETRY_PRIOR:
            fields["T_prior_base"] = self.pose()
        elif topic is LABEL_ADD:
            fields["name"] = self.odd(f"thing {self.random.randrange(300)}", NAMES)
        elif topic is CONTROL:
            fields["command"] = self.random.choice(COMMANDS)
        elif topic is MAP_REFINE:
            fields["iterations"] = self.odd(2, ITERATIONS)
            fields |= {name: self.odd(1.0, RATES) for name in ("initial_rate", "final_rate")}
        else:
            self.move()
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
        if self.random.random() < 0.02:  # Some topics reject more than 65,536 bytes.
            unknown_bytes = unknown_bytes or 10 ** self.random.randrange(7)
        if unknown_bytes:
            fields["unknown"] = bytes(unknown_bytes)
        try:
            body = bytearray(encode(fields))
        except OverflowError:
            return b"\xc1"
        if self.random.random() < self.ratio / 3:
            body[self.random.randrange(len(body))] ^= 1 << self.random.randrange(8)
        return bytes(body)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a run: number of inputs, how the stages counted them, and the largest memory."""

    inputs: int
    handled: int
    rejected: int
    dropped: int  # Messages dropped because newer ones came, or while the stages were paused.
    commands: int  # Control requests that were executed.
    commands_refused: int
    keyframes: int  # Keyframes that the mapper handled.
    heartbeats: int
    dead_letters: int
    failures: int  # Exceptions in steps and heartbeats, dead letters included.
    max_queued_mb: float  # Sum over all stages, with unpaired images.
    seconds: float

    @property
    def is_clean(self) -> bool:
        """True if no message and no heartbeat failed."""
        return self.dead_letters == self.failures == 0


# Little work per keyframe, so that most of the time is left for further inputs.
MAPPER = MapperConfig(
    iterations=1,
    min_iterations=1,
    threads=1,
    refit=LoopRefitConfig(iterations=1, deduplication_iterations=0),
)


class EveryFailure(FailureLog):
    """Log of failed steps without a limit of lines per minute."""

    def step_failed(self, name: str, what: str, *, is_of_message: bool) -> None:  # noqa: ARG002
        super().step_failed(name, what, is_of_message=False)


class FailurePrinter(logging.Handler):
    """Log handler that prints each exception with the seed and the input that it followed."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self._seed, self.inputs = seed, 0

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info:
            where = f"seed {self._seed}, input {self.inputs}"
            print(f"{where}: {self.format(record)}", file=sys.stderr, flush=True)


class Service:
    """The stages with inputs from outside, and their `Control`, in one event loop."""

    def __init__(self, transport: MemoryTransport) -> None:
        makers: dict[type[Actor], Callable[[], Actor]] = {
            FrameSource: FrameSource,
            Tracker: Tracker,
            VlmLabeller: lambda: VlmLabeller(labeller=labeller()),
            Mapper: lambda: Mapper(MAPPER),
            LoopCloser: LoopCloser,
            Optimizer: Optimizer,
        }
        config = SupervisionConfig(heartbeat_s=0.05)
        self.stages = [
            Stage(
                make,
                transport,
                config=config,
                expected={
                    out.topic.name: lossless_consumers(makers, out.topic.name)
                    for out in actor.outputs
                },
            )
            for actor, make in makers.items()
        ]
        for stage in self.stages:
            stage._failure_log = EveryFailure()
        names = [stage.name for stage in self.stages]
        self.tasks = [asyncio.create_task(s.run(), name=s.name) for s in self.stages]
        self._control = Control(transport, names, names[:1], "memory", timeout_s=30.0)
        self.commands = Counter[bool]()  # Numbers of executed and refused commands.

    async def command(self, body: bytes) -> None:
        """Execute an encoded command; a pause is followed by `resume` before the next input."""
        answer = decode(await self._control.answer(body), ControlAnswer)
        self.commands[answer.ok] += 1
        if self.stages[0].health().paused:
            await self.command(
                encode({"type": "ControlRequest", "stamp_ns": 0, "command": "resume"})
            )

    def queued_mb(self) -> float:
        """Return the size of the queued messages of all stages and of unpaired images, MB."""
        mailboxes = [stage._mailbox for stage in self.stages]
        queued = [d.body.nbytes for m in mailboxes if m for d in list(m._order)]
        frame_source = self.stages[0]._actor
        assert isinstance(frame_source, FrameSource)
        return (sum(queued) + frame_source._pairing.waiting_bytes) / 1e6

    async def settle(self) -> None:
        """Wait until the frame source and the tracker have taken all messages.

        Raises:
            RuntimeError: A stage has ended, or takes no message for a minute.
        """
        for stage in self.stages[:2]:
            until_s = time.monotonic() + SETTLED_WITHIN_S
            while stage._mailbox and stage._mailbox._order and not stage._mailbox.is_held:
                self.require_running()
                if time.monotonic() > until_s:
                    raise RuntimeError(f"{stage.name} takes no message for {SETTLED_WITHIN_S:g} s")
                await asyncio.sleep(0.0005)

    def require_running(self) -> None:
        """Check that no stage has ended.

        Raises:
            RuntimeError: A stage has ended.
        """
        for task in self.tasks:
            if task.done():
                raise RuntimeError(f"{task.get_name()} ended unexpectedly: {task.exception()!r}")

    async def stop(self) -> None:
        """Cancel all stages."""
        self._control.close()
        for task in self.tasks:
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)
        Worker.busy_workers(10.0)  # The interpreter must not end during a step.


def labeller() -> HttpLabeller:
    """Return a labeller that sends no request, because the mapper requests no label."""
    return HttpLabeller("http://127.0.0.1:9/v1", names=("chair",))


async def run(seed: int, is_over: Callable[[int, float], bool]) -> Outcome:
    """Send generated inputs to all stages until `is_over(inputs, seconds)`.

    Raises:
        RuntimeError: A stage has ended, or the queued messages are too large.
    """
    generator, transport = Generator(random.Random(seed)), MemoryTransport()
    heartbeats: list[int] = [0]

    def count_heartbeat(_header: bytes, _body: memoryview) -> None:
        heartbeats[0] += 1

    service = Service(transport)
    for stage in service.stages:
        transport.subscribe(f"health/{stage.name}", count_heartbeat)
    await asyncio.sleep(0)
    inputs, peak, started_s = 0, 0.0, time.monotonic()
    try:
        while not is_over(inputs, time.monotonic() - started_s):
            topic, header, body = generator.next_input()
            inputs += 1
            if topic is CONTROL:
                await service.command(body)
            else:
                transport.deliver(topic.name, header, body)
            peak = max(peak, service.queued_mb())
            if peak > MAX_MB:
                raise RuntimeError(f"{peak:.0f} MB are queued, must be at most {MAX_MB:.0f} MB")
            if inputs % 4 == 0:
                await service.settle()
            service.require_running()
        healths = [stage.health() for stage in service.stages]
    except RuntimeError as error:
        raise RuntimeError(f"seed {seed}, input {inputs}: {error}") from error
    finally:
        await service.stop()
    outside = {topic.name for topic in TOPICS}
    counts = [count for health in healths for count in health.inputs if count.topic in outside]
    return Outcome(
        inputs=inputs,
        handled=sum(count.delivered for count in counts),
        rejected=sum(count.rejected for count in counts),
        dropped=sum(count.dropped + count.dropped_paused for count in counts),
        commands=service.commands[True],
        commands_refused=service.commands[False],
        keyframes=sum(
            count.delivered
            for health in healths
            for count in health.inputs
            if count.topic == "keyframe/new"
        ),
        heartbeats=heartbeats[0],
        dead_letters=sum(health.dead_lettered for health in healths),
        failures=sum(health.failures for health in healths),
        max_queued_mb=round(peak, 2),
        seconds=time.monotonic() - started_s,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    until = parser.add_mutually_exclusive_group()
    until.add_argument("--inputs", type=int, default=10_000)
    until.add_argument("--minutes", type=float)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    printer = FailurePrinter(arguments.seed)
    logging.getLogger().addHandler(printer)

    def is_over(inputs: int, seconds: float) -> bool:
        printer.inputs = inputs
        if arguments.minutes is not None:
            return seconds >= 60 * arguments.minutes
        return inputs >= arguments.inputs

    try:
        outcome = asyncio.run(run(arguments.seed, is_over))
    except RuntimeError as error:
        print(f"hostile input: {error}", file=sys.stderr)
        return 1
    finally:
        logging.getLogger().removeHandler(printer)
    print(*(f"{name}={value:.6g}" for name, value in asdict(outcome).items()))
    rate = outcome.inputs / outcome.seconds
    print(f"{rate:.0f} inputs/s; 10^6 take {1e6 / rate / 60:.0f} min")
    return 0 if outcome.is_clean else 1


if __name__ == "__main__":
    sys.exit(main())
