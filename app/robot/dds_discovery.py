"""Who writes what in a DDS domain, from what its participants announce.

ROS 2 maps the topic `/name` to `rt/name` and the type `sensor_msgs/msg/Imu` to
`sensor_msgs::msg::dds_::Imu_`. Nothing in that says which node or robot a topic is of.
"""

from __future__ import annotations

from dataclasses import dataclass

from app.robot.ros_graph import MOST_ENDPOINTS, NAME, TYPE, Publisher
from app.robot.zenoh_link import TOO_MANY
from pipeline.io.readers.base import count_loss

_PREFIX, _LONGEST = "rt/", 256


@dataclass(frozen=True, slots=True)
class Offer:
    """What a writer says of itself.

    Attributes:
        topic, msgtype: In the ROS 2 spelling.
        reliable: Whether it sends again what got lost.
        latched: Whether it keeps what it said for who comes late.
    """

    topic: str
    msgtype: str
    reliable: bool
    latched: bool

    @classmethod
    def of(cls, topic: str, type_name: str, *, reliable: bool, latched: bool) -> Offer | None:
        """A writer by the names that it announces; None where it writes no topic of ROS."""
        if len(topic) > _LONGEST or len(type_name) > _LONGEST or not topic.startswith(_PREFIX):
            return None
        name, kind = topic[len(_PREFIX) - 1 :], TYPE.fullmatch(type_name)
        if kind is None or not NAME.fullmatch(name):
            return None
        return cls(name, f"{kind[1]}/msg/{kind[2]}", reliable, latched)


class DdsGraph:
    """The writers that are alive now.

    Args:
        robot: Its topics alone count, those below `/robot/`; "" takes all as those of one robot.
    """

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._alive: dict[str, Offer] = {}

    def add(self, key: str, offer: Offer | None, losses: dict[str, int]) -> bool:
        """A writer was announced; whether that changes anything."""
        if offer is None or self._alive.get(key) == offer:
            return False
        if len(self._alive) >= MOST_ENDPOINTS:
            count_loss(losses, TOO_MANY)
            return False
        self._alive[key] = offer
        return True

    def remove(self, key: str) -> bool:
        """A writer is gone; whether it was known."""
        return self._alive.pop(key, None) is not None

    def publishers(self) -> list[Publisher]:
        """All topics that are written, each once, by name."""
        found = {(self._owner(offer.topic), offer.topic, offer.msgtype) for offer in self._alive.values()}
        return [Publisher(*each) for each in sorted(found)]

    def common(self, topic: str, msgtype: str) -> Offer | None:
        """What all writers of a topic offer, None where there is none."""
        there = [o for o in self._alive.values() if (o.topic, o.msgtype) == (topic, msgtype)]
        if not there:
            return None
        reliable = all(offer.reliable for offer in there)
        return Offer(topic, msgtype, reliable, reliable and all(offer.latched for offer in there))

    def _owner(self, topic: str) -> str:
        return self._robot if self._robot and topic.startswith(f"/{self._robot}/") else ""
