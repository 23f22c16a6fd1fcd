"""CPU time of `Slam` beside that of `ldo run` on equal frames, and equality of their results.

    python -m tests.bench.bench_library SOURCE [--max-frames 40] [--pairs 3] [--python PYTHON]

Each pair runs `ldo run` and a program of ten lines with `Slam`, each in a process of its own, one
after the other. The program reads the same frames and hands them over as arrays. PYTHON is the
interpreter of an environment with the package; the default is this one. CPU time is user and system
time of the process with all threads, from its start to its end.
"""

import argparse
import filecmp
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

PROGRAM = """
import sys
from ldo_service import Slam, open_sequence
source, count, folder = sys.argv[1], int(sys.argv[2]), sys.argv[3]
sequence = open_sequence(source)
first = sequence.read(0)
with Slam(first.camera, depth_scale=first.depth_scale) as slam:
    for index in range(count):
        frame = sequence.read(index)
        slam.track(frame.color, frame.depth, frame.stamp_ns)
    slam.finish()
    slam.save(folder)
"""
FILES = ("trajectory.txt", "map.ply", "keyframes.json", "loops.json")


def cpu_s(command: list[str], folder: Path) -> float:
    """Run a command outside the checkout, and return its CPU time in seconds."""
    before = getrusage(RUSAGE_CHILDREN)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run(command, check=True, capture_output=True, cwd=folder, env=environment)
    after = getrusage(RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source")
    parser.add_argument("--max-frames", type=int, default=40)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--python", default=sys.executable)
    options = parser.parse_args()
    count = str(options.max_frames)
    print("| pair | `ldo run`, CPU s | `Slam`, CPU s | ratio | equal files |")
    print("|---|---|---|---|---|", flush=True)
    totals = [0.0, 0.0]
    for pair in range(options.pairs):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            run = [options.python, "-m", "ldo_service", "run", options.source, "--out", "run"]
            program = [options.python, "-c", PROGRAM, options.source, count, "slam"]
            times_s = cpu_s([*run, "--max-frames", count], folder), cpu_s(program, folder)
            equal, *_ = filecmp.cmpfiles(folder / "run", folder / "slam", FILES, shallow=False)
        totals = [total + time_s for total, time_s in zip(totals, times_s, strict=True)]
        print(
            f"| {pair + 1} | {times_s[0]:.2f} | {times_s[1]:.2f} | {times_s[1] / times_s[0]:.3f} | "
            f"{', '.join(equal)} |",
            flush=True,
        )
    print(f"| all | {totals[0]:.2f} | {totals[1]:.2f} | {totals[1] / totals[0]:.3f} | |")


if __name__ == "__main__":
    main()
