"""What nodes of ROS 2 get, without ROS: outputs: {ros2: {}}, then  python listen.py (the router, too)."""

import json
import sys

import zenoh
from rosbags.typesys import Stores, get_typestore

types, port = get_typestore(Stores.ROS2_JAZZY), sys.argv[1] if len(sys.argv) > 1 else "7447"
router = {"mode": "router", "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]}}
router["scouting"] = {"multicast": {"enabled": False}}  # for this machine alone
with zenoh.open(zenoh.Config.from_json5(json.dumps(router))) as session:
    transforms = session.declare_subscriber("0/tf/**")
    for sample in transforms:
        for each in types.deserialize_cdr(bytes(sample.payload), "tf2_msgs/msg/TFMessage").transforms:
            stamp, turn = each.header.stamp, each.transform.rotation
            at = f"{stamp.sec}.{stamp.nanosec:09d}"
            print(at, each.child_frame_id, f"{turn.x:.3f} {turn.y:.3f} {turn.z:.3f} {turn.w:.3f}", flush=True)
