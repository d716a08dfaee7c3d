"""Who publishes what, from the liveliness tokens that rmw_zenoh declares for nodes and endpoints.

The form of a token: `@ros2_lv/<domain>/<session>/<node>/<entity>/<kind>/<enclave>/<namespace>/<name>`,
and for an endpoint `/<topic>/<type>/<hash>/<qos>` after it; a slash inside of a part is written `%`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

ADMIN = "@ros2_lv"
PUBLISHER = "MP"
TYPE = re.compile(r"([A-Za-z][A-Za-z0-9_]*)::msg::dds_::([A-Za-z][A-Za-z0-9_]*)_")
#: What cannot be said as a key of Zenoh is no name of ROS: empty parts, wildcards.
NAME = re.compile(r"(?:/[A-Za-z0-9_.~-]+)+")
#: A network that says more of itself than this is not a robot's.
MOST_ENDPOINTS = 5000
_LONGEST = 1000


@dataclass(frozen=True, slots=True)
class Publisher:
    """A topic that somebody publishes.

    Attributes:
        robot: The publisher's namespace without slashes at its ends, "" for none.
        topic: With its leading slash.
        msgtype: In the ROS 2 spelling, e.g. "sensor_msgs/msg/PointCloud2".
    """

    robot: str
    topic: str
    msgtype: str


def publisher_of(token: str) -> Publisher | None:
    """What a token says; None when it is not of a publisher, or of another form."""
    parts = token.split("/")
    if len(token) > _LONGEST or len(parts) != 13 or parts[0] != ADMIN or parts[5] != PUBLISHER:
        return None
    msgtype = TYPE.fullmatch(parts[10])
    topic = parts[9].replace("%", "/")
    namespace = parts[7].replace("%", "/")
    if msgtype is None or not NAME.fullmatch(topic) or not (namespace == "/" or NAME.fullmatch(namespace)):
        return None
    return Publisher(namespace.strip("/"), topic, f"{msgtype[1]}/msg/{msgtype[2]}")


def data_key(domain: int, topic: str, msgtype: str, type_hash: str = "*") -> str:
    """The key of a topic's messages; any hash of the type unless one is given."""
    package, _, name = msgtype.split("/")
    return f"{domain}/{topic.lstrip('/')}/{package}::msg::dds_::{name}_/{type_hash}"


class RosGraph:
    """The publishers that are alive now, and which robots were heard of before."""

    def __init__(self) -> None:
        self._alive: dict[str, Publisher] = {}

    def add(self, token: str) -> bool:
        """A token was declared. Returns whether there was room for it; what is no publisher needs none."""
        publisher = publisher_of(token)
        if publisher is None or token in self._alive:
            return True
        if len(self._alive) >= MOST_ENDPOINTS:
            return False
        self._alive[token] = publisher
        return True

    def remove(self, token: str) -> None:
        """A token is gone."""
        self._alive.pop(token, None)

    def publishers(self) -> list[Publisher]:
        """All that are alive, each once, by robot and topic."""
        return sorted(set(self._alive.values()), key=lambda p: (p.robot, p.topic, p.msgtype))

    def robots(self, scan_types: tuple[str, ...]) -> list[str]:
        """The namespaces from which scans are published, by name."""
        return sorted({p.robot for p in self._alive.values() if p.msgtype in scan_types})
