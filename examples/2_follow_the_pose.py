"""Subscriber that prints each camera pose of a running service.

Each line shows the time stamp in nanoseconds, the tracking status (OK, WEAK or LOST) and the
camera position in meters. `T_odom_camera` is continuous except after relocalization. The globally
consistent pose is `T_map_odom.matrix() @ T_odom_camera.matrix()`.

Start `ldo serve` and a camera, such as `ldo publish synthetic:room`, each in its own terminal. Then
run:

    .venv/bin/python examples/2_follow_the_pose.py [POSES]
"""

import sys

from ldo_service.client import connect

count = int(sys.argv[1]) if len(sys.argv) > 1 else sys.maxsize

with connect("robot") as service:
    for number, pose in enumerate(service.poses(), 1):
        x, y, z = pose.T_odom_camera.translation
        print(f"{pose.stamp_ns} {pose.status} {x:.3f} {y:.3f} {z:.3f}", flush=True)
        if number == count:
            break
