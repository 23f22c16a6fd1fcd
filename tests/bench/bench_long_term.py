"""Memory growth per keyframe by owner, for a camera that moves to and fro in a room.

    python -m tests.bench.bench_long_term [--keyframes 3000] [--laps 1000] [--csv FILE]
        [--set actor.field=value ...]
    python -m tests.bench.bench_long_term --plot PNG --beside OLD.csv NEW.csv

All actors run on the logical clock at 160x120. After each lap (to and fro) the attributes of each
actor are measured recursively, and its state is encoded as in a checkpoint. The report has bytes
per keyframe over the second half, when caches are full. It has bytes per lap if the camera only
reuses known keyframes. It lists every attribute that grows, and sums. `not found` is the growth of
the process beyond the measured objects: gtsam, allocators, fragmentation.
"""

import argparse
import csv
import ctypes
import gc
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType, MethodType, ModuleType

import cv2
import msgspec
import numpy as np

from ldo_service.actors.topology import make_actors
from ldo_service.config import actor_parameters, latency_frames, load_config
from ldo_service.runtime import Actor
from ldo_service.runtime.logical_clock import LogicalClock
from ldo_service.runtime.process import resident_mb, trim_memory
from ldo_service.schemas import CameraRgbd, Keyframe, Message
from ldo_service.storage.state_codec import encode_state
from tests.faults.camera import PERIOD_NS, frames

LIGHT = ("mapper.iterations=2", "mapper.threads=1")
SHARED = (type, ModuleType, FunctionType, MethodType)  # Types of objects that belong to no actor.
DEEP = 4  # Maximum number of attributes in a path.
MIN_BYTES = 1.0  # Minimum growth per keyframe of a reported path.


class Mallinfo2(ctypes.Structure):
    """Result of glibc's mallinfo2 over all arenas, in bytes."""

    _fields_ = [
        *((name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "mapped")),
        *((name, ctypes.c_size_t) for name in ("usmblks", "fsmblks", "in_use", "free", "keepcost")),
    ]


@dataclass(frozen=True, slots=True)
class Sample:
    keyframes: int
    held: dict[str, int]  # Bytes in memory by the path of attributes.
    saved: dict[str, int]  # Bytes of the encoded state by actor.
    resident: float  # Resident bytes of the process.
    in_use: int  # Bytes allocated from glibc, without small Python objects.
    free: int  # Free bytes that glibc keeps.


def lap(scene: list[CameraRgbd], number: int) -> Iterator[CameraRgbd]:
    """Yield the frames of one lap; numbers and stamps continue from lap to lap."""
    for index, frame in enumerate(scene, start=number * len(scene)):
        stamp_ns = 1_000_000_000 + index * PERIOD_NS
        yield msgspec.structs.replace(frame, frame=index, stamp_ns=stamp_ns)


# --- what an actor holds --------------------------------------------------------------------------
def held_by(actors: list[Actor]) -> dict[str, int]:
    """Return the bytes by path; an object with several owners counts for the first."""
    seen: set[int] = set()
    held: dict[str, int] = {}
    for actor in actors:
        _walk(actor, actor.name, 0, seen, held)
    return held


def _walk(thing: object, path: str, depth: int, seen: set[int], held: dict[str, int]) -> None:
    """Add the bytes of an object to `held`.

    Attributes of our own classes get a path each; everything below counts for the last of them.
    """
    if id(thing) in seen or isinstance(thing, SHARED):
        return
    if depth < DEEP and type(thing).__module__.startswith("ldo_service"):
        seen.add(id(thing))
        held[path] = held.get(path, 0) + sys.getsizeof(thing)
        for name, value in _attributes(thing).items():
            _walk(value, f"{path}.{name}", depth + 1, seen, held)
    else:
        held[path] = held.get(path, 0) + _deep_size(thing, seen)


def _attributes(thing: object) -> dict[str, object]:
    slots = [name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ())]
    of_slots = {name: getattr(thing, name) for name in slots if hasattr(thing, name)}
    of_slots.pop("__dict__", None), of_slots.pop("__weakref__", None)
    return {**of_slots, **getattr(thing, "__dict__", {})}


def _deep_size(thing: object, seen: set[int]) -> int:
    total, waiting = 0, [thing]
    while waiting:
        one = waiting.pop()
        if id(one) in seen or isinstance(one, SHARED):
            continue
        seen.add(id(one))
        total += sys.getsizeof(one)
        waiting.extend(_referents(one))
    return total


def _referents(one: object) -> list[object]:
    if isinstance(one, np.ndarray):
        return [] if one.base is None else [one.base]
    if isinstance(one, memoryview):
        return [one.obj]
    return gc.get_referents(one)


# --- the run --------------------------------------------------------------------------------------
def journey(keyframes: int, max_laps: int, settings: list[str]) -> Iterator[Sample]:
    config, scene = load_config(settings=[*LIGHT, *settings]), frames()
    actors, made, laps = make_actors(actor_parameters(config)), 0, 0

    def observe(_actor: str, message: Message, _step_ms: float) -> None:
        nonlocal made
        made += isinstance(message, Keyframe)

    for actor in actors:
        keep_state(actor)
    with LogicalClock(actors, latency_frames(config), observe) as clock:
        while made < keyframes and laps < max_laps:
            for _tick in clock.run(lap(scene, laps)):
                pass
            laps += 1
            yield sample(actors, made)


def keep_state(actor: Actor) -> None:
    """Make an actor save its state after each message, as a stage may do."""
    handle = actor.handle

    def handled(message: Message) -> Iterator[Message]:
        yield from handle(message)
        actor.snapshot()
        actor.on_saved()

    actor.handle = handled


def sample(actors: list[Actor], keyframes: int) -> Sample:
    saved = {actor.name: len(encode_state(actor.snapshot())) for actor in actors}
    gc.collect()
    trim_memory()
    return Sample(keyframes, held_by(actors), saved, 1e6 * resident_mb(), *allocated())


def allocated() -> tuple[int, int]:
    libc = ctypes.CDLL(None)
    libc.mallinfo2.restype = Mallinfo2
    statistics = libc.mallinfo2()
    return statistics.in_use + statistics.mapped, statistics.free


def growth(samples: list[Sample]) -> tuple[str, dict[str, float], dict[str, float], float]:
    """Return the growth in bytes per keyframe over the second half.

    Without new keyframes the growth is per lap.

    Returns:
        The unit ("keyframe" or "lap"), the growth by path, that of the saved states by actor, and
        that of the resident memory.
    """
    half = len(samples) // 2 - 1
    first, last = samples[half], samples[-1]
    n = last.keyframes - first.keyframes
    unit = "keyframe" if n else "lap"
    n = n or len(samples) - 1 - half
    held = {path: (size - first.held.get(path, 0)) / n for path, size in last.held.items()}
    saved = {actor: (size - first.saved[actor]) / n for actor, size in last.saved.items()}
    return unit, held, saved, (last.resident - first.resident) / n


def report(samples: list[Sample]) -> None:
    unit, held, saved, resident = growth(samples)
    print(f"| held by | bytes per {unit} | kB now |\n|---|---|---|")
    for path, slope in sorted(held.items(), key=lambda item: -item[1]):
        if slope >= MIN_BYTES:
            print(f"| {path} | {slope:.0f} | {samples[-1].held[path] / 1e3:.0f} |")
    for actor, slope in saved.items():
        mine = sum(s for path, s in held.items() if path.split(".")[0] == actor)
        print(f"| {actor}, total; saved state {slope:.0f} | {mine:.0f} | |")
    print(f"| resident, of it not found {resident - sum(held.values()):.0f} | {resident:.0f} | |")


# --- comparison of runs ---------------------------------------------------------------------------
WIDTH, HEIGHT, MARGIN = 640, 260, 50
COLORS = ((200, 80, 40), (31, 111, 235), (40, 140, 60))  # RGB, one per file.


def save(path: Path, samples: list[Sample]) -> None:
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("keyframes", "found_mb", "resident_mb"))
        for one in samples:
            rows.writerow((one.keyframes, sum(one.held.values()) / 1e6, one.resident / 1e6))


def plot(files: list[Path]) -> np.ndarray:
    """Return an image of the measured memory over keyframes, one curve per file."""
    image = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    runs = [np.loadtxt(path, delimiter=",", skiprows=1) for path in files]
    most = np.max([run.max(axis=0) for run in runs], axis=0)
    size = np.array([WIDTH - 2 * MARGIN, -(HEIGHT - 2 * MARGIN)])
    for number, (path, run) in enumerate(zip(files, runs, strict=True)):
        points = (MARGIN, HEIGHT - MARGIN) + size * run[:, :2] / most[:2]
        color, line = COLORS[number], points.round().astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(image, [line], False, color, 1, cv2.LINE_AA)
        write(image, path.stem, (MARGIN + 120 * number, HEIGHT - 12), color)
    write(image, f"MB held by the actors, 0 to {most[1]:.0f}", (MARGIN, 24))
    write(image, f"{most[0]:.0f} keyframes", (WIDTH - 140, HEIGHT - 34))
    return image


def write(
    image: np.ndarray, text: str, at: tuple[int, int], color: tuple[int, int, int] = (60, 60, 60)
) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--keyframes", type=int, default=3000)
    parser.add_argument(
        "--laps", type=int, default=1000, help="maximum number of laps, each to and fro"
    )
    parser.add_argument("--set", nargs="+", default=[], help="settings, as for `ldo serve`")
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--plot", type=Path)
    parser.add_argument(
        "--beside", type=Path, nargs="+", default=[], help="CSV files that --plot compares"
    )
    arguments = parser.parse_args()
    if arguments.plot:
        cv2.imwrite(str(arguments.plot), plot(arguments.beside)[..., ::-1])
        return
    samples: list[Sample] = []
    for one in journey(arguments.keyframes, arguments.laps, arguments.set):
        samples.append(one)
        total = sum(one.held.values())
        print(
            f"{one.keyframes} keyframes: {total / 1e6:.1f} MB found, "
            f"{one.resident / 1e6:.0f} MB resident, {one.in_use / 1e6:.1f} MB of glibc in use, "
            f"{one.free / 1e6:.1f} MB free",
            flush=True,
        )
    report(samples)
    if arguments.csv:
        save(arguments.csv, samples)


if __name__ == "__main__":
    main()
