"""Tests of the kernels' threads: concurrent calls, and their state between calls."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from ldo_service.evaluation.iteration import bench_camera, walls
from ldo_service.gaussians import Rasterizer
from ldo_service.geometry import se3

CAMERA = bench_camera(96, 64)
ROWS = walls(5000, CAMERA)

# Beginning of the programs below.
PROGRAM = """
import os, threading, time
from pathlib import Path
import numpy as np
from ldo_service.evaluation.iteration import bench_camera, walls
from ldo_service.gaussians import render

camera = bench_camera(96, 64)
rows = walls(5000, camera)

def picture(threads):
    return render(rows, camera, np.eye(4), threads=threads).color.tobytes()

def tasks():
    return set(os.listdir("/proc/self/task"))
"""


def run(body: str) -> None:
    """Run Python lines in a separate process, which must exit with 0 and print no error."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-W", "ignore::DeprecationWarning", "-c", PROGRAM + body],
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")


def planes_of(threads: int, step: int) -> bytes:
    """Render the scene from one of several poses and return the bytes of the planes."""
    T_camera_map = se3.exp([0, 0.02 * step, 0, 0, 0, 0])
    return Rasterizer(threads=threads).render(ROWS, CAMERA, T_camera_map).tobytes()


def test_callers_at_once_with_other_numbers_of_threads_get_the_same_bits() -> None:
    alone = [planes_of(1, step) for step in range(8)]
    calls = [(threads, step) for step in range(8) for threads in (1, 2, 3, 5, 2, 8)]
    with ThreadPoolExecutor(6) as callers:
        planes = callers.map(lambda call: planes_of(*call), calls)
        for (_, step), bits in zip(calls, planes, strict=True):
            assert bits == alone[step]


def test_one_thread_makes_none_and_more_are_kept() -> None:
    run("""
before = tasks()
picture(1)
assert tasks() == before
picture(3)
helpers = tasks() - before
assert len(helpers) == 2
for threads in (2, 1, 3, 3, 2):
    picture(threads)
assert tasks() - before == helpers
""")


def test_threads_sleep_between_calls() -> None:
    run("""
before = tasks()
picture(4)

def asleep(task):
    stat = Path(f"/proc/self/task/{task}/stat").read_text()
    return stat.rpartition(")")[2].split()[0] == "S"

helpers = tasks() - before
while not all(map(asleep, helpers)):
    time.sleep(0.001)
for _ in range(20):
    time.sleep(0.002)
    assert all(map(asleep, helpers))
""")


@pytest.mark.parametrize("busy", ["False", "True"])
def test_forked_child_gets_threads_of_its_own(busy: str) -> None:
    run(f"""
is_done = False
def render_on():
    while not is_done:
        picture(2)
other = threading.Thread(target=render_on)
wanted = picture(2)
if {busy}:
    other.start()
for _ in range(5):
    child = os.fork()
    if child == 0:
        before = tasks()
        is_equal = picture(3) == wanted and picture(2) == wanted
        os._exit(0 if is_equal and len(tasks() - before) == 2 else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert picture(2) == wanted
is_done = True
""")
