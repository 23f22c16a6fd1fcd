"""Camera that publishes color and depth to a running service.

The example sends frames of the built-in synthetic room at 15 Hz. Replace the room by any source of
NumPy arrays: a RealSense, a Kinect or a simulator. Depth must be registered to color.

Start `ldo serve` in another terminal, then run:

    .venv/bin/python examples/1_publish_a_camera.py [FRAMES]
"""

import sys
import time

from ldo_service.client import connect
from ldo_service.datasets import open_sequence
from ldo_service.schemas import CameraModel

frames = int(sys.argv[1]) if len(sys.argv) > 1 else 120
room = open_sequence("synthetic:room")
k = room.camera
camera = CameraModel(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)

with connect("robot") as service:
    for index in range(frames):
        frame = room[index % len(room)]
        service.publish(frame.color, frame.depth_m, camera, depth_scale=1.0)
        time.sleep(1 / 15)
print(f"{frames} frames sent")
