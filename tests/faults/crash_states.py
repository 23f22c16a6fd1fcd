"""Power cuts at any point of a run of all actors, after which the service must start unattended.

.venv/bin/python -m tests.faults.crash_states --states 10000 --seed 1
.venv/bin/python -m tests.faults.crash_states --states 10000 --seed 1 --fsync
"""

import argparse
import asyncio
import logging
import random
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

from ldo_service.errors import LdoError
from ldo_service.gaussians.offloading import OffloadedGaussians
from ldo_service.runtime.delivery_state import OFFSETS, RestoredState
from ldo_service.runtime.generations import GenerationKeeper, problem_of_states
from ldo_service.service.state_folder import claim_state
from ldo_service.storage.state_store import FolderStore, State

from .disk_log import CrashState, DiskLog, crash_state, recorded
from .small_service import ACTORS, open_service

KEYFRAMES = "keyframe/new"
# Keyframes after which the run begins the next generation: the keyframes of `KEEP_EVERY_S` at two
# keyframes per second.
KEEP_EVERY_KEYFRAMES = 2


async def record_run(folder: Path, frames: int, *, syncs: bool) -> DiskLog:
    """Run all actors for some frames, and record all changes of their state folder.

    The notes of the log are the number of keyframes in the last saved state of the tracker.
    """
    save = FolderStore.save

    with recorded(folder) as log:

        def on_save(
            store: FolderStore, actor: str, state: State, unsynced: Iterable[Path] = ()
        ) -> None:
            save(store, actor, state, unsynced)
            if actor == "tracker":
                log.note(keyframes_of(state))

        with patch.object(FolderStore, "save", on_save), ExitStack() as stack:
            claim_state(folder, stack)
            async with open_service(folder, syncs=syncs) as service:
                for index in range(frames):
                    await service.send_frame(index)
                    if index % KEEP_EVERY_KEYFRAMES == 0:
                        async with service.keeper.lock:
                            pass  # The generation before is complete.
                        keeping = asyncio.create_task(_keep(service.keeper))
                await keeping
                await service.wait_until_quiet()
                await service.stop()
    return log


async def _keep(keeper: GenerationKeeper) -> None:
    async with keeper.lock:
        await keeper.keep()


def keyframes_of(state: State | None) -> int:
    """Return the number of keyframes that the tracker has produced."""
    made = RestoredState.of(state).outputs.get(KEYFRAMES) if state and OFFSETS in state else None
    return made.seq if made else 0


def start_after(state: CrashState, folder: Path) -> int:
    """Start the service in the folder that a power cut left.

    Returns:
        The number of lost keyframes.

    Raises:
        LdoError: The service does not start.
        AssertionError: The states do not belong together, or files of the map are missing.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    state.write(folder)
    with ExitStack() as stack:
        claim_state(folder, stack)
    store = FolderStore(folder / "state")
    problem = problem_of_states(store, ACTORS, is_quick=True)  # `claim_state` has read the rest.
    assert problem is None, problem
    _check_offloaded(folder, store)
    return max(0, (state.last_note or 0) - keyframes_of(store.load("tracker")))


def _check_offloaded(folder: Path, store: FolderStore) -> None:
    """Check that the offloaded Gaussians of the restored map are whole."""
    mapper = store.load("mapper") or {}
    if "map" not in mapper:
        return
    offloaded = OffloadedGaussians(folder / "map" / "gaussians")
    offloaded.restore(mapper["map"]["map"]["sleeping"])
    for _ in offloaded.chunks():
        pass
    assert offloaded.metrics()["gaussians_lost_on_disk"] == 0, "offloaded Gaussians are lost"


def lost_keyframes(
    log: DiskLog, states: int, seed: int, folder: Path
) -> tuple[Counter[int], list[str]]:
    """Start the service after power cuts at random points.

    Args:
        log: Log of a run.
        states: Number of power cuts.
        seed: Seed of the points and of the lost changes.
        folder: Folder for the states, which is overwritten.

    Returns:
        Number of states by lost keyframes, and a description of each start that failed.
    """
    rng, lost, failed = random.Random(seed), Counter[int](), list[str]()
    for number in range(states):
        end = rng.randrange(len(log.changes) + 1)
        try:
            lost[start_after(crash_state(log, end, rng), folder)] += 1
        except (LdoError, AssertionError) as error:
            failed.append(f"state {number} after {end} changes: {error!r:.400}")
    return lost, failed


@contextmanager
def recorded_run(
    description: str | None, states: int, frames: int
) -> Iterator[tuple[argparse.Namespace, Path, DiskLog]]:
    """Parse the options of a program, and record a run of all actors.

    Args:
        description: Description of the program.
        states: Default number of power cuts.
        frames: Default number of frames of the run.

    Yields:
        The options, a temporary folder, and the log of the run.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--states", type=int, default=states)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=frames)
    parser.add_argument("--fsync", action="store_true")
    given = parser.parse_args()
    logging.getLogger().addHandler(logging.NullHandler())
    with tempfile.TemporaryDirectory() as name:
        run = Path(name) / "run"
        run.mkdir()
        yield given, Path(name), asyncio.run(record_run(run, given.frames, syncs=given.fsync))


def main() -> None:
    with recorded_run(__doc__, states=10_000, frames=16) as (given, folder, log):
        started_s = time.monotonic()
        lost, failed = lost_keyframes(log, given.states, given.seed, folder / "copy")
    limit = 0 if given.fsync else 5
    print(f"{len(log.changes)} changes of {max(c.note or 0 for c in log.changes)} keyframes")
    for keyframes, count in sorted(lost.items()):
        print(f"{keyframes} keyframes lost: {count}")
    print(f"{sum(lost.values())} of {given.states} states started unattended in "
          f"{time.monotonic() - started_s:.0f} s, seed {given.seed}")  # fmt: skip
    print("\n".join(failed[:10]))
    raise SystemExit(bool(failed) or max(lost) > limit)


if __name__ == "__main__":
    main()
