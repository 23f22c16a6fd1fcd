"""Starts of all actors from the states that power cuts leave.

`crash_states.py` checks the files of many states. This program runs the actors from some of them:
each actor restores its state, and all of them handle the next frames of the camera.

.venv/bin/python -m tests.faults.crash_starts --states 105 --seed 1
.venv/bin/python -m tests.faults.crash_starts --states 105 --seed 1 --fsync
"""

import asyncio
import random
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from ldo_service.errors import LdoError
from ldo_service.schemas import decode
from ldo_service.schemas.pose import TrackedPose
from ldo_service.schemas.topics import POSE_TRACKED
from ldo_service.service.state_folder import claim_state
from ldo_service.storage.state_store import FolderStore
from tests.runtime.fake_actors import eventually

from .crash_states import keyframes_of, recorded_run
from .disk_log import CrashState, DiskLog, crash_state
from .small_service import ACTORS, SmallService, open_service

NEXT_FRAMES = 2  # Frames after the start.
# Services that run at the same time in one event loop. Each of them mostly waits for heartbeats.
CONCURRENT = 4


@dataclass(frozen=True, slots=True)
class Start:
    """Start of all actors from the state that a power cut left."""

    lost_keyframes: int  # Keyframes that the tracker had saved before, and has not any more.
    is_fall_back: bool  # The actors fell back to an older generation.
    restored: frozenset[str]  # Actors that restored a saved state.


def power_cuts(log: DiskLog, states: int, seed: int) -> list[CrashState]:
    """Return the folder after power cuts at random changes.

    Each actor has the same number of power cuts directly after a change of its own files.

    Args:
        log: Log of a run.
        states: Number of power cuts.
        seed: Seed of the points and of the lost changes.
    """
    rng = random.Random(seed)
    ends = {
        actor: [n for n, change in enumerate(log.changes, 1) if _is_of(actor, change.path)]
        for actor in ACTORS
    }
    actors = [ACTORS[number % len(ACTORS)] for number in range(states)]
    return [crash_state(log, rng.choice(ends[actor]), rng) for actor in actors]


def _is_of(actor: str, path: str) -> bool:
    parts = Path(path).parts
    if parts[:1] == ("map",):
        return actor == "mapper"
    return len(parts) > 1 and parts[1].partition(".")[0] == actor


async def start_actors(state: CrashState, folder: Path, *, syncs: bool) -> Start:
    """Start all actors in the folder that a power cut left, and send them the next frames.

    Raises:
        LdoError: The service does not start.
        AssertionError: An actor fails, or does not handle the next frames.
    """
    folder.mkdir()
    state.write(folder)
    with ExitStack() as stack:
        claim_state(folder, stack)
        store = FolderStore(folder / "state")
        restored = frozenset(actor for actor in ACTORS if store.load(actor))
        before = keyframes_of(store.load("tracker"))
        async with open_service(folder, syncs=syncs) as service:
            # The frame source may have saved the frame after the tracker's last keyframe.
            await _send_next_frames(service, before, first=(state.last_note or 0) + 1)
            is_fall_back = bool(service.metric("tracker", "fell_back"))
            await service.stop()
    return Start(max(0, (state.last_note or 0) - before), is_fall_back, restored)


async def _send_next_frames(service: SmallService, before: int, first: int) -> None:
    """Send the next frames, and check that all actors handle them."""
    poses = list[TrackedPose]()
    service.transport.subscribe(
        POSE_TRACKED.name, lambda _, body: poses.append(decode(body, TrackedPose))
    )
    for index in range(first, first + NEXT_FRAMES):
        await service.send_frame(index)
    keyframes = before + NEXT_FRAMES  # The camera turns by a keyframe per frame.
    try:
        await eventually(lambda: _unhandled(service, keyframes) == {})
    except AssertionError:
        raise AssertionError(f"not handled: {_unhandled(service, keyframes)}") from None
    assert [pose.status for pose in poses[-NEXT_FRAMES:]] == ["OK"] * NEXT_FRAMES
    for actor in ACTORS:
        health = service.health(actor)
        assert (health.failures, health.dead_lettered, health.restarts) == (0, 0, 0), actor
        assert not any(count.lost for count in health.inputs), actor
        for name in ("keyframes_repeated", "keyframes_damaged", "gaussians_lost_on_disk"):
            assert not health.metrics.get(name), (actor, name)


def _unhandled(service: SmallService, keyframes: int) -> dict[str, float]:
    """Return what the actors have not handled; empty if they have handled all keyframes."""
    behind = {
        f"{actor} {output.topic} {consumer}": float(count)
        for actor in ACTORS
        for output in service.health(actor).outputs
        for consumer, count in output.behind.items()
    }
    missing = {
        f"{actor} keyframes": keyframes - service.metric(actor, "keyframes")
        for actor in ("mapper", "optimizer")
    }
    return {name: count for name, count in (behind | missing).items() if count}


async def start_all(
    states: list[CrashState], folder: Path, *, syncs: bool
) -> tuple[list[Start], list[str]]:
    """Start all actors after each power cut.

    Args:
        states: Folders after the power cuts.
        folder: Folder for the copies.
        syncs: Whether the services sync all files, as in the recorded run.

    Returns:
        The starts, and a description of each one that failed.
    """
    starts, failed, slots = list[Start](), list[str](), asyncio.Semaphore(CONCURRENT)

    async def start(number: int, state: CrashState) -> None:
        async with slots:
            try:
                starts.append(await start_actors(state, folder / str(number), syncs=syncs))
            except (LdoError, AssertionError) as error:
                failed.append(f"state {number}: {error!r:.400}")

    await asyncio.gather(*(start(number, state) for number, state in enumerate(states)))
    return starts, failed


def main() -> None:
    with recorded_run(__doc__, states=105, frames=10) as (given, folder, log):
        began_s = time.process_time()
        states = power_cuts(log, given.states, given.seed)
        starts, failed = asyncio.run(start_all(states, folder, syncs=given.fsync))
    lost = Counter(start.lost_keyframes for start in starts)
    for keyframes, count in sorted(lost.items()):
        print(f"{keyframes} keyframes lost: {count}")
    restored = Counter(actor for start in starts for actor in start.restored)
    print(", ".join(f"{actor} restored {restored[actor]} states" for actor in ACTORS))
    print(f"{sum(start.is_fall_back for start in starts)} fell back to an older generation")
    print(f"{len(starts)} of {given.states} states started unattended and handled "
          f"{NEXT_FRAMES} frames in {time.process_time() - began_s:.0f} s of CPU time, "
          f"seed {given.seed}")  # fmt: skip
    print("\n".join(failed[:10]))
    raise SystemExit(bool(failed) or max(lost) > (0 if given.fsync else 5))


if __name__ == "__main__":
    main()
