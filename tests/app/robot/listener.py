"""Somebody on the robot's network who knows nothing of us: `python tests/app/robot/listener.py PORT ROBOT`.

Discovers what stemmap publishes as `ros2 topic list` does, subscribes with type hashes that it computes
itself, and prints what it heard of each topic as JSON.
"""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_topic_names_and_types
from zenoh_ros2_sdk.utils import get_type_hash

_STORE: Any = get_typestore(Stores.ROS2_JAZZY)
_DEFINED = {
    "pose": "geometry_msgs/msg/PoseStamped",
    "odometry": "nav_msgs/msg/Odometry",
    "path": "nav_msgs/msg/Path",
    "trees": "visualization_msgs/msg/MarkerArray",
    "clearance": "sensor_msgs/msg/Range",
    "zone": "std_msgs/msg/UInt8",
}


def parts_of(msgtype: str) -> dict[str, str]:
    """The definitions of a type and of all in it, by name."""
    text = _STORE.generate_msgdef(msgtype, ros_version=2)[0]
    first, *rest = text.split("=" * 80 + "\n")
    parts = {msgtype: first}
    for part in rest:
        head, _, body = part.partition("\n")
        package, name = head.removeprefix("MSG: ").split("/")
        parts[f"{package}/msg/{name}"] = body
    return parts


def main(port: int, robot: str) -> None:
    """Listen until stdin ends."""
    heard: dict[str, Any] = {}
    changed = threading.Condition()

    def note(topic: str, message: Any) -> None:
        with changed:
            heard[topic] = message
            changed.notify()

    kept = []
    for topic, msgtype in _DEFINED.items():
        parts = parts_of(msgtype)
        own = parts.pop(msgtype)
        kept.append(
            ROS2Subscriber(
                topic=f"/{robot}/stemmap/{topic}",
                msg_type=msgtype,
                callback=lambda message, topic=topic: note(topic, message),
                msg_definition=_STORE.generate_msgdef(msgtype, ros_version=2)[0],
                type_hash=get_type_hash(msgtype, own, parts),
                router_ip="127.0.0.1",
                router_port=port,
                domain_id=0,
            )
        )
    print(json.dumps({"ready": True}), flush=True)
    with changed:
        changed.wait_for(lambda: len(heard) == len(_DEFINED))
    found = get_topic_names_and_types(domain_id=0, router_ip="127.0.0.1", router_port=port)
    told = {
        "topics": sorted(str(each[0]) for each in found if "/stemmap/" in str(each[0])),
        "pose_frame": heard["pose"].header.frame_id,
        "child": heard["odometry"].child_frame_id,
        "markers": len(heard["trees"].markers),
        "poses": len(heard["path"].poses),
        "ahead": round(float(heard["clearance"].range), 3),
        "zone": int(heard["zone"].data),
    }
    print(json.dumps(told), flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
