"""Flipped bits in every file of a real state folder, each of which must be detected.

.venv/bin/python -m tests.faults.bit_flips --flips 10000 --seed 1
"""

import argparse
import asyncio
import logging
import random
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ldo_service.errors import DataError
from ldo_service.runtime.delivery_state import RestoredState
from ldo_service.runtime.generations import MARKER, completed_generation
from ldo_service.runtime.quarantine import Quarantine
from ldo_service.service.state_folder import claim_state
from ldo_service.storage.checksummed_folder import ChecksummedFolder
from ldo_service.storage.message_log import MessageLog
from ldo_service.storage.state_store import CONTENTS, NEWEST, FolderStore

from .small_service import open_service

FRAMES = 6
NOT_STATE = ("lock",)  # Files without content.


async def make_state(folder: Path, frames: int = FRAMES) -> None:
    """Run all actors for some frames, and leave their state in a folder."""
    with ExitStack() as stack:
        claim_state(folder, stack)
        async with open_service(folder) as service:
            for index in range(frames):
                await service.send_frame(index)
                await service.wait_until_quiet()
                if index == frames - 2:  # The last frame is in the newest states alone.
                    await service.keeper.keep()
            await service.stop()


def files_of(folder: Path) -> list[Path]:
    """Return all files of a state folder that hold state."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return [path for path in files if path.name not in NOT_STATE and path.stat().st_size]


def is_damage_detected(folder: Path, path: Path) -> bool:
    """Read a file as the service does, and return whether its damage is noticed."""
    kind, *names = path.relative_to(folder).parts
    if kind == "map":
        files = ChecksummedFolder(path.parent, path.suffix[1:], "")
        return _raises(lambda: files.read(int(path.stem)))
    store = FolderStore(folder / "state")
    if names[0] == MARKER:
        return _raises(lambda: completed_generation(store))
    actor, _, what = names[0].partition(".")
    if what == "quarantine":
        with logged_errors() as errors:
            Quarantine(path.parent)
        return bool(errors)
    if what == "backlog":
        return _is_lost_message_logged(store, actor, path.parent)
    generations = [NEWEST, *_generations(path.parent)]
    return any(_raises(lambda g=g: store.load(actor, g)) for g in generations)


def _raises(read: Callable[[], object]) -> bool:
    try:
        read()
    except DataError:
        return True
    return False


def _generations(folder: Path) -> Iterator[int]:
    for path in folder.glob("generation-*.msgpack"):
        yield int(path.stem.partition("-")[2])


def _is_lost_message_logged(store: FolderStore, actor: str, folder: Path) -> bool:
    past = RestoredState.of(store.load(actor)).outputs[folder.name.replace(".", "/")]
    with logged_errors() as errors:
        log = MessageLog(folder, past.epoch, past.handled, past.seq, max_bytes=1 << 40)
        for seq in range(log.first, log.next):
            log.read(seq)
    return bool(errors)


@contextmanager
def logged_errors() -> Iterator[list[str]]:
    """Collect the errors that the block logs."""
    errors: list[str] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: errors.append(record.getMessage())  # type: ignore[method-assign]
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield errors
    finally:
        root.removeHandler(handler)


def undetected_flips(folder: Path, flips: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Flip random bits, one at a time, in all files in turn.

    Args:
        folder: A state folder; it is unchanged afterwards.
        flips: Number of flips. Each file gets at least one if there are enough.
        seed: Seed of the random positions.

    Returns:
        Number of flips by kind of file, and a description of each flip that was not detected.
    """
    rng, files = random.Random(seed), files_of(folder)
    rng.shuffle(files)
    tried: Counter[str] = Counter()
    missed: list[str] = []
    for number in range(flips):
        path = files[number % len(files)]
        body = path.read_bytes()
        bit = rng.randrange(8 * len(body))
        flipped = bytearray(body)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        if not is_damage_detected(folder, path):
            missed.append(f"bit {bit} of {path.relative_to(folder)} ({len(body)} bytes)")
        if not path.exists() or path.read_bytes() != body:  # Logs truncate what they cannot read.
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(body)
        tried[_kind(folder, path)] += 1
    return tried, missed


def _kind(folder: Path, path: Path) -> str:
    parts = path.relative_to(folder).parts
    if parts[0] == "map":
        return path.suffix[1:]
    if path.name.startswith(("generation", CONTENTS)):
        return "list of files"
    return parts[1].partition(".")[2] or "part of a state"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flips", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "state"
        folder.mkdir()
        asyncio.run(make_state(folder))
        logging.getLogger().addHandler(logging.NullHandler())
        started_s = time.monotonic()
        tried, missed = undetected_flips(folder, given.flips, given.seed)
    for kind, count in tried.most_common():
        print(f"{kind}: {count}")
    print(f"{sum(tried.values()) - len(missed)} of {sum(tried.values())} flips detected in "
          f"{time.monotonic() - started_s:.0f} s, seed {given.seed}")  # fmt: skip
    print("\n".join(missed[:20]))
    raise SystemExit(bool(missed))


if __name__ == "__main__":
    main()
