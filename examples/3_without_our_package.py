"""Subscriber that prints each camera pose without the package ldo-slam.

Any language with Zenoh and MessagePack can read the topics in the same way. `ldo topics
--json-schema` describes every message.

Run `.venv/bin/pip install eclipse-zenoh msgpack`. Start `ldo serve` and a camera, such as `ldo
publish synthetic:room`, each in its own terminal. Then run:

    .venv/bin/python examples/3_without_our_package.py [POSES]
"""

import json
import sys

import msgpack
import zenoh

count = int(sys.argv[1]) if len(sys.argv) > 1 else sys.maxsize
config = zenoh.Config()
config.insert_json5("mode", json.dumps("client"))
config.insert_json5("connect/endpoints", json.dumps(["tcp/127.0.0.1:7447"]))
config.insert_json5("scouting/multicast/enabled", "false")

with (
    zenoh.open(config) as session,
    session.declare_subscriber(
        "ldo/robot/pose/tracked",
        zenoh.handlers.RingChannel(1),  # Keeps only the newest pose.
    ) as poses,
):
    for number, sample in enumerate(poses, 1):
        pose = msgpack.unpackb(sample.payload.to_bytes())
        print(pose["stamp_ns"], pose["status"], *pose["T_odom_camera"]["translation"], flush=True)
        if number == count:
            break
