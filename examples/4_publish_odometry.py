"""Publisher of an odometry prior, from wheels or an inertial unit, without the package ldo-slam.

The service uses the prior as the initial guess of tracking. Each message is the pose of the robot's
base in a fixed frame that the sender chooses; only the motion between two messages is used. Stamps
must come from the same clock as the stamps of the camera frames. The setting
`tracker.T_base_camera` of the service is the pose of the camera in the frame of the base.

A real robot publishes the poses that its odometry measures. This example reads poses from a file
instead and sends each pose at its time. The lines of the file are `stamp tx ty tz qx qy qz qw`, in
seconds and meters.

Run `.venv/bin/pip install eclipse-zenoh msgpack`. Start `ldo serve`, then this program, then `ldo
publish` of the sequence that belongs to the file:

    .venv/bin/python examples/4_publish_odometry.py FILE
"""

import json
import sys
import time

import msgpack
import zenoh

config = zenoh.Config()
config.insert_json5("mode", json.dumps("client"))
config.insert_json5("connect/endpoints", json.dumps(["tcp/127.0.0.1:7447"]))

with open(sys.argv[1]) as file:
    poses = [[float(word) for word in line.split()] for line in file if line[0] not in "#\n"]

with (
    zenoh.open(config) as session,
    session.declare_publisher("ldo/robot/odometry/prior") as prior,
):
    while not prior.matching_status.matching:  # type: ignore[attr-defined]
        time.sleep(0.1)
    started_s = time.monotonic()
    for stamp_s, x, y, z, *xyzw in poses:
        norm = sum(q * q for q in xyzw) ** 0.5
        # The message needs a unit quaternion, but quaternions in the file are rounded.
        qx, qy, qz, qw = (q / norm for q in xyzw)
        time.sleep(max(0.0, started_s + stamp_s - poses[0][0] - time.monotonic()))
        message = {
            "type": "OdometryPrior",
            "stamp_ns": round(stamp_s * 1e9),
            "T_prior_base": {"translation": [x, y, z], "quaternion": [qw, qx, qy, qz]},
        }
        prior.put(msgpack.packb(message))
print(f"{len(poses)} poses sent")
