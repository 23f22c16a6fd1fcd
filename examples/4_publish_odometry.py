"""Help tracking with another odometry, of wheels or an inertial unit, and without our package.

Each message says where the robot's base is, in a frame that only the sender knows: what counts is
the motion between two messages. Stamps are of the clock that stamps the camera's frames; where the
camera sits on the base is `tracker.T_base_camera` of the service. Here the poses are lines of a
file, `stamp tx ty tz qx qy qz qw` in seconds and metres, sent when they are due; a robot sends what
its driver says. Start `ldo serve`, this, and `ldo publish` of the sequence that the file goes with.

    python examples/4_publish_odometry.py FILE
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
        qx, qy, qz, qw = (q / norm for q in xyzw)  # a file has few digits, and we are exact
        time.sleep(max(0.0, started_s + stamp_s - poses[0][0] - time.monotonic()))
        message = {
            "type": "OdometryPrior",
            "stamp_ns": round(stamp_s * 1e9),
            "T_prior_base": {"translation": [x, y, z], "quaternion": [qw, qx, qy, qz]},
        }
        prior.put(msgpack.packb(message))
print(f"{len(poses)} poses sent")
