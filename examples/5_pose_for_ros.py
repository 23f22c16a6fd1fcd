"""Publisher of the camera pose on /tf of ROS 2, through the bridge zenoh-bridge-ros2dds.

The program publishes two transforms as CDR on the Zenoh key `tf`: `ldo_odom` in its parent frame
`ldo_map`, and `ldo_camera` in its parent frame `ldo_odom`. The bridge forwards them to the ROS
topic `/tf` while that topic has subscribers. The axes of `ldo_map` and `ldo_odom` are those of the
camera at its first pose: x right, y down, z forward.

Run `.venv/bin/pip install -e '.[ros2]'`. Start `ldo serve` and a camera, such as `ldo publish
synthetic:room`. Start the bridge: `zenoh-bridge-ros2dds -m client -e tcp/127.0.0.1:7447`. Then run:

    .venv/bin/python examples/5_pose_for_ros.py [POSES]
"""

import json
import sys

import zenoh
from rosbags.typesys import Stores, get_typestore

from ldo_service.client import connect
from ldo_service.schemas import Pose

count = int(sys.argv[1]) if len(sys.argv) > 1 else sys.maxsize
ros = get_typestore(Stores.ROS2_HUMBLE)
types = ros.types
config = zenoh.Config()
config.insert_json5("mode", json.dumps("client"))
config.insert_json5("connect/endpoints", json.dumps(["tcp/127.0.0.1:7447"]))


def transform(stamp_ns: int, parent: str, child: str, T_parent_child: Pose):
    """Return a geometry_msgs/TransformStamped of a pose."""
    w, x, y, z = T_parent_child.quaternion
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return types["geometry_msgs/msg/TransformStamped"](
        types["std_msgs/msg/Header"](stamp, parent),
        child,
        types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](*T_parent_child.translation),
            types["geometry_msgs/msg/Quaternion"](x, y, z, w),
        ),
    )


with connect("robot") as service, zenoh.open(config) as session:
    for number, pose in enumerate(service.poses(), 1):
        if pose.status != "LOST":
            odom = transform(pose.stamp_ns, "ldo_map", "ldo_odom", pose.T_map_odom)
            camera = transform(pose.stamp_ns, "ldo_odom", "ldo_camera", pose.T_odom_camera)
            message = types["tf2_msgs/msg/TFMessage"]([odom, camera])
            session.put("tf", bytes(ros.serialize_cdr(message, message.__msgtype__)))
        if number == count:
            break
