"""Short recordings for tests: slices of one recording in the layout of TUM RGB-D."""

import shutil
from pathlib import Path


def write_slice(source: Path, target: Path, first: int, count: int) -> Path:
    """Write some frames of a recording as a recording of its own, and return its folder.

    Args:
        source: Recording with rgb.txt and depth.txt, whose lines belong to each other.
        target: Folder to create.
        first: Index of the first frame.
        count: Number of frames.
    """
    target.mkdir(parents=True)
    for kind in ("rgb", "depth"):
        lines = (source / f"{kind}.txt").read_text().splitlines()[first : first + count]
        (target / f"{kind}.txt").write_text("\n".join(lines) + "\n")
        (target / kind).mkdir()
        for line in lines:
            name = line.split()[1]
            shutil.copy(source / name, target / name)
    for name in ("camera.json", "groundtruth.txt"):
        shutil.copy(source / name, target / name)
    return target
