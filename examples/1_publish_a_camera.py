"""Be a camera: send colour and depth to a running service.

Start `ldo serve` first. Any source of arrays will do in place of the built-in synthetic room: a
RealSense, a Kinect, a simulator. Depth must be registered to colour.

    python examples/1_publish_a_camera.py [FRAMES]
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
