"""A robot that knows nothing of us: `python publisher.py PORT RUN.mcap [--robot NAME] [--rate X]`.

zenoh-ros2-sdk declares and publishes as rmw_zenoh does; rosbags reads the recording. It tells on stdout
what it does, a line of JSON each, and begins to send at a line on stdin.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher
from zenoh_ros2_sdk.session import ZenohSession

_STORE: Any = get_typestore(Stores.ROS2_JAZZY)


def publisher(port: int, topic: str, msgtype: str, namespace: str) -> Any:
    """A publisher of one topic."""
    return ROS2Publisher(
        topic=topic,
        msg_type=msgtype,
        msg_definition=_STORE.generate_msgdef(msgtype, ros_version=2)[0],
        type_hash=_STORE.hash_rihs01(msgtype),
        node_name="driver",
        namespace=namespace,
        router_ip="127.0.0.1",
        router_port=port,
        domain_id=0,
    )


def fields_of(message: Any) -> dict[str, Any]:
    """The fields of a message by name."""
    return {name: getattr(message, name) for name in message.__dataclass_fields__}


def own(store: Any, message: Any) -> Any:
    """The message in the classes of the publisher's own store."""
    if isinstance(message, list):
        return [own(store, each) for each in message]
    if not hasattr(message, "__msgtype__"):
        return message
    fields = {name: own(store, value) for name, value in fields_of(message).items()}
    return store.types[message.__msgtype__](**fields)


def tell(**what: Any) -> None:
    print(json.dumps(what), flush=True)


def main() -> None:
    """Send a recording at its own pace, or faster."""
    parser = argparse.ArgumentParser()
    parser.add_argument("port", type=int)
    parser.add_argument("run", type=Path)
    parser.add_argument("--robot", default="")
    parser.add_argument("--rate", type=float, default=1.0)
    arguments = parser.parse_args()
    namespace = f"/{arguments.robot}" if arguments.robot else "/"
    with AnyReader([arguments.run]) as reader:
        publishers = {
            c.topic: publisher(arguments.port, namespace.rstrip("/") + c.topic, c.msgtype, namespace)
            for c in reader.connections
        }
        tell(ready=True)
        sys.stdin.readline()
        store = ZenohSession.get_instance().store
        began, first, sent = time.monotonic(), None, 0
        for connection, time_ns, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            first = time_ns if first is None else first
            due = began + (time_ns - first) * 1e-9 / arguments.rate
            time.sleep(max(0.0, due - time.monotonic()))
            fields = {name: own(store, value) for name, value in fields_of(message).items()}
            publishers[connection.topic].publish(**fields)
            sent += connection.msgtype == "sensor_msgs/msg/PointCloud2"
        tell(scans=sent, seconds=round(time.monotonic() - began, 3))
        sys.stdin.readline()
        for each in publishers.values():
            each.close()
        ZenohSession.get_instance().close()


if __name__ == "__main__":
    main()
