"""Where is the camera: print each pose as it comes.

Start `ldo serve`, and a camera: `ldo publish synthetic:room`. `T_odom_camera` is continuous,
but after a loss; `T_map_odom` from the left makes it the globally consistent pose.

    python examples/2_follow_the_pose.py [POSES]
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
