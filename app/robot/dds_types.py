"""ROS 2's message types as CycloneDDS wants them: made of the definitions that recordings are read with."""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype

from pipeline.io.readers.ros_messages import standard_types

_STRING = "string"


@cache
def idl_type(msgtype: str) -> Any:  # noqa: ANN401 - cyclonedds is an extra, and imported where it is used
    """The IDL structure of a message, under the name that ROS 2 gives it on the network.

    Args:
        msgtype: In the ROS 2 spelling, e.g. "sensor_msgs/msg/PointCloud2".

    Returns:
        A class of cyclonedds, named e.g. "sensor_msgs.msg.dds_.PointCloud2_".
    """
    from cyclonedds.idl import make_idl_struct

    package, _, name = msgtype.split("/")
    fields = standard_types("cdr").fielddefs[msgtype][1]
    members = {field: _kind(kind) for field, kind in fields}
    return make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", members)


def _kind(described: Any) -> Any:  # noqa: ANN401 - as rosbags describes a field
    from cyclonedds.idl import types

    node, detail = described
    if node == Nodetype.BASE:
        plain = {"bool": bool, _STRING: str, "byte": types.uint8, "octet": types.uint8, "char": types.uint8}
        return plain.get(detail[0]) or getattr(types, detail[0])
    if node == Nodetype.NAME:
        return idl_type(detail)
    inner, length = detail
    if node == Nodetype.ARRAY:
        return types.array[_kind(inner), length]
    return types.sequence[_kind(inner), length] if length else types.sequence[_kind(inner)]
