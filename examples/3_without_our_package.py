"""The same without our package: any language with Zenoh and MessagePack reads the topics.

Needs `pip install eclipse-zenoh msgpack`. Start `ldo serve` and a camera first. `ldo topics
--json-schema` describes every message.

    python examples/3_without_our_package.py [POSES]
"""

import json
import sys

import msgpack
import zenoh

count = int(sys.argv[1]) if len(sys.argv) > 1 else sys.maxsize
config = zenoh.Config()
config.insert_json5("mode", json.dumps("client"))
config.insert_json5("connect/endpoints", json.dumps(["tcp/127.0.0.1:7447"]))

with (
    zenoh.open(config) as session,
    session.declare_subscriber(
        "ldo/robot/pose/tracked",
        zenoh.handlers.RingChannel(1),  # never be late: an older pose is overwritten
    ) as poses,
):
    for number, sample in enumerate(poses, 1):
        pose = msgpack.unpackb(sample.payload.to_bytes())
        print(pose["stamp_ns"], pose["status"], *pose["T_odom_camera"]["translation"], flush=True)
        if number == count:
            break
