"""Time of recording on the event loop and in the writer's thread, and bytes on disk.

python tests/bench/bench_journal.py [FOLDER]
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from ldo_service.recordings.mcap_file import RecordConfig
from ldo_service.recordings.recorder import Recorder
from ldo_service.runtime import In, Latest
from ldo_service.runtime.actor import FlowStatus
from ldo_service.runtime.inlet import Delivery
from ldo_service.runtime.step import Produced
from ldo_service.schemas import Array, CameraModel, FrameRgbd, encode
from ldo_service.schemas.topics import FRAME_RGBD
from ldo_service.transport.flow_control import Header

FRAMES = 150
HEIGHT, WIDTH = 480, 640


def frame(index: int) -> FrameRgbd:
    rng = np.random.default_rng(index)
    return FrameRgbd(
        stamp_ns=index,
        frame=index,
        camera=CameraModel(width=WIDTH, height=HEIGHT, fx=500.0, fy=500.0, cx=320.0, cy=240.0),
        color=Array.of(rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)),
        depth_m=Array.of(rng.random((HEIGHT, WIDTH), np.float32)),
    )


def main(folder: Path) -> None:
    messages = [frame(i) for i in range(8)]
    bodies = [encode(message) for message in messages]
    path = folder / "bench.mcap"
    recorder = Recorder(path, {}, RecordConfig(queue_mb=4096))
    loop_s, cpu_s, wall_s = 0.0, time.process_time(), time.perf_counter()
    for i in range(FRAMES):
        body = bodies[i % 8]
        delivery = Delivery(In(FRAME_RGBD, Latest(1)), Header("camera", 1, i, i), memoryview(body))
        started_s = time.perf_counter()
        recorder.record_input(delivery, i)
        recorder.record_step("done", FlowStatus(), [Produced(FRAME_RGBD, messages[i % 8], body)])
        loop_s += time.perf_counter() - started_s
        time.sleep(1 / 60)  # Twice the rate of a camera; the loop also has other work.
    recorder.close().result()
    cpu_s, wall_s = time.process_time() - cpu_s, time.perf_counter() - wall_s
    size = path.stat().st_size
    path.unlink()
    print(
        f"{os.uname().machine}, {FRAMES} frames of {WIDTH}x{HEIGHT}, one input and one output each"
    )
    print(f"event loop   {1e3 * loop_s / FRAMES:.3f} ms per frame")
    print(f"CPU, total   {1e3 * cpu_s / FRAMES:.2f} ms per frame (digests of both included)")
    print(f"on disk      {size / FRAMES:.0f} bytes per frame, {len(bodies[0])} bytes of message")
    print(f"wall         {wall_s:.2f} s")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            main(Path(folder))
