"""Writer of the golden state of the current version, which later versions must load.

    .venv/bin/python -m tests.faults.golden_state

Run it when `STATE_VERSION` changes, and commit the new file. Earlier files never change.
"""

import asyncio
import tarfile
import tempfile
from pathlib import Path

from ldo_service.runtime.generations import keep_stopped, next_generation
from ldo_service.storage.state_contents import STATE_VERSION
from ldo_service.storage.state_store import FolderStore

from .bit_flips import make_state
from .small_service import ACTORS

GOLDEN = Path(__file__).parent.parent / "storage" / "golden"
KEYFRAMES = 3  # Keyframes in each golden state.
MOMENTS = ("mean", "square")  # Moments of Adam, which do not compress.


def write_golden_state() -> Path:
    """Run all actors, and write their state to a new file of `GOLDEN`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        asyncio.run(make_state(folder, KEYFRAMES))
        store = FolderStore(folder / "state")
        state = store.load("mapper")
        assert state is not None
        for moment in MOMENTS:
            state["map"]["map"]["optimizer"][moment][:] = 0
        store.save("mapper", state)
        keep_stopped(store, ACTORS, next_generation(store))
        path = GOLDEN / f"state-v{STATE_VERSION}.tar.xz"
        with tarfile.open(path, "w:xz") as archive:
            archive.add(folder, ".")
    return path


if __name__ == "__main__":
    print(write_golden_state())
