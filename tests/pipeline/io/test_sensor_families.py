"""The family of a topic by its fields, its message type and its names."""

from __future__ import annotations

import pytest

from pipeline.io.readers.point_times import time_fields
from pipeline.io.readers.sensor_families import (
    DEPTH_CAMERA,
    FAMILIES,
    HESAI,
    LIVOX,
    OUSTER,
    OUSTER_PACKETS,
    ROBOSENSE,
    VELODYNE,
    SensorFamily,
    family_of,
    family_of_messages,
)
from pipeline.io.readers.topics import TYPES_BY_ROLE

XYZ = ("x", "y", "z", "intensity")
#: Fields of a point as the drivers of the makers write them.
FIELDS = (
    (VELODYNE, (*XYZ, "ring", "time")),
    (OUSTER, (*XYZ, "t", "reflectivity", "ring", "ambient", "range")),
    (HESAI, (*XYZ, "timestamp", "ring")),
    (ROBOSENSE, (*XYZ, "ring", "timestamp")),
    (LIVOX, (*XYZ, "tag", "line", "timestamp")),
)


@pytest.mark.parametrize(("family", "fields"), FIELDS, ids=[family.name for family, _ in FIELDS])
def test_the_fields_of_a_driver_are_of_its_family_and_have_times(
    family: SensorFamily, fields: tuple[str, ...]
):
    assert family_of(fields, "sensor_msgs/msg/PointCloud2", organised=family in (ROBOSENSE, OUSTER)) is family
    assert time_fields(fields)


@pytest.mark.parametrize(
    ("fields", "names", "organised", "family"),
    [
        ((*XYZ, "ring", "timestamp"), ("/rslidar_points", "rslidar"), False, ROBOSENSE),
        ((*XYZ, "timestamp", "ring"), ("/hesai/pandar", "hesai_lidar"), True, HESAI),
        ((*XYZ, "ring", "timestamp"), ("/points", "lidar"), False, HESAI),
        ((*XYZ, "ring", "timestamp"), ("/points", "lidar"), True, ROBOSENSE),
        ((*XYZ, "t", "ring"), ("/points", "base_link"), False, OUSTER),
        ((*XYZ, "ring", "time"), ("/points_raw", ""), False, VELODYNE),
        ((*XYZ, "tag", "line"), ("/points",), False, LIVOX),
        (XYZ, ("/livox/lidar", "livox_frame"), False, LIVOX),
        (XYZ, ("/points", "lidar"), False, None),
        (XYZ, ("/points", "lidar"), True, DEPTH_CAMERA),
        (("x", "y", "z", "rgb"), ("/camera/depth/color/points",), False, DEPTH_CAMERA),
        (("range", "bearing"), ("/points",), False, None),
    ],
)
def test_the_family_of_a_cloud(
    fields: tuple[str, ...], names: tuple[str, ...], organised: bool, family: SensorFamily | None
):
    assert family_of(fields, "sensor_msgs/msg/PointCloud2", names=names, organised=organised) is family


def test_a_message_type_is_of_one_family_and_is_read_if_the_table_says_so():
    for family in FAMILIES:
        for msgtype in family.messages:
            assert family_of_messages(msgtype) is family
            assert family_of((), msgtype) is family
            # Packets of Ouster become clouds before their topic is chosen.
            assert (msgtype in TYPES_BY_ROLE["scan"]) is (msgtype not in OUSTER_PACKETS)
    assert family_of_messages("sensor_msgs/msg/PointCloud2") is None
