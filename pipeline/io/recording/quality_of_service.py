"""What `ros2 bag play` must know of each topic, in the words of ROS 2 Humble, which later ones read too.

Without it every topic is replayed as volatile, and whoever joins late, or insists on a latched
/tf_static as RViz does, never hears where the LiDAR stands on the robot.
"""

from __future__ import annotations

# Marks the numbers below as those of Humble; later releases write words instead.
BAG_METADATA = ("rosbag2", {"ROS_DISTRO": "humble"})

_KEEP_LAST, _RELIABLE, _TRANSIENT_LOCAL, _VOLATILE, _AUTOMATIC = 1, 1, 1, 2, 1
_FOREVER = "{sec: 9223372036, nsec: 854775807}"


def offered_qos_profiles(latched: bool) -> str:
    """The profile of a topic as YAML; `latched` keeps the last message for those who come later."""
    return (
        f"- history: {_KEEP_LAST}\n"
        f"  depth: {1 if latched else 10}\n"
        f"  reliability: {_RELIABLE}\n"
        f"  durability: {_TRANSIENT_LOCAL if latched else _VOLATILE}\n"
        f"  deadline: {_FOREVER}\n"
        f"  lifespan: {_FOREVER}\n"
        f"  liveliness: {_AUTOMATIC}\n"
        f"  liveliness_lease_duration: {_FOREVER}\n"
        f"  avoid_ros_namespace_conventions: false\n"
    )
