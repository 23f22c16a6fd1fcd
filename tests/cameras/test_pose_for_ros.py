"""The example that publishes poses to ROS, read by rosbags as a ROS node would read it."""

import subprocess
import sys
import time
from pathlib import Path

import zenoh

from ldo_service.schemas import encode
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.flow_control import Header, encode_link
from ldo_service.transport.zenoh_transport import open_session
from tests.ports import free_endpoint
from tests.schemas.examples import EXAMPLES

from .ros import STORE

EXAMPLE = Path(__file__).parent.parent.parent / "examples" / "5_pose_for_ros.py"


def test_poses_are_published_as_transforms() -> None:
    endpoint, pose = free_endpoint(), EXAMPLES["tracked_pose"]
    program = EXAMPLE.read_text().replace("tcp/127.0.0.1:7447", endpoint)
    program = program.replace('connect("robot")', f'connect("robot", "{endpoint}")')
    with open_session(Endpoint("robot", endpoint), router=True) as session:
        subscriber = session.declare_subscriber("tf", zenoh.handlers.FifoChannel(9))
        with subprocess.Popen([sys.executable, "-c", program, "1"]) as process:
            while process.poll() is None:
                header = encode_link(Header("tracker", 1, 0, pose.stamp_ns))
                session.put("ldo/robot/pose/tracked", encode(pose), attachment=header)
                time.sleep(0.05)
        sample = subscriber.try_recv()
    assert process.returncode == 0
    assert sample is not None
    message = STORE.deserialize_cdr(sample.payload.to_bytes(), "tf2_msgs/msg/TFMessage")
    odom, camera = message.transforms
    assert (odom.header.frame_id, odom.child_frame_id) == ("ldo_map", "ldo_odom")
    assert (camera.header.frame_id, camera.child_frame_id) == ("ldo_odom", "ldo_camera")
    assert camera.header.stamp.nanosec == pose.stamp_ns
    t, q = camera.transform.translation, camera.transform.rotation
    assert [t.x, t.y, t.z] == [1.0, -2.0, 0.5]
    assert [q.w, q.x, q.y, q.z] == [0.5, -0.5, 0.5, 0.5], "ROS stores w last, under its name"
