"""What we say of pose, path and trees, decoded by the definitions in it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pipeline.geometry.poses import Pose2
from pipeline.io.readers.topics import standard_types
from pipeline.io.recording import messages
from pipeline.types.records import Clearance, Zone
from tests.app.fakes import START_NS, frame, path, trees


def decoded(topic: str, payload: bytes) -> Any:
    """A message by its own definition alone."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(messages.definition(messages.TYPES[topic]), messages.TYPES[topic]))
    return store.deserialize_cdr(payload, messages.TYPES[topic])


@given(st.floats(-100, 100), st.floats(-100, 100), st.floats(-3, 3))
def test_the_pose_and_its_covariance_arrive(x: float, y: float, yaw: float):
    seen = frame(0, START_NS)
    estimate = replace(seen.estimate, T_map_base=Pose2(x, y, yaw), covariance=np.diag([0.04, 0.09, 0.01]))
    found = messages.pose_messages(replace(seen, estimate=estimate))
    for topic in (messages.POSE, messages.ODOMETRY):
        message = decoded(topic, found[topic])
        pose = message.pose if topic == messages.POSE else message.pose.pose
        assert (pose.position.x, pose.position.y, pose.position.z) == (x, y, 0.0)
        assert 2 * np.arctan2(pose.orientation.z, pose.orientation.w) == pytest.approx(yaw)
        assert message.header.frame_id == "map"
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == START_NS
    covariance = decoded(messages.ODOMETRY, found[messages.ODOMETRY]).pose.covariance.reshape(6, 6)
    assert [covariance[k, k] for k in (0, 1, 5)] == [0.04, 0.09, 0.01]
    assert np.count_nonzero(covariance) == 3


def test_each_confirmed_tree_is_a_stem_a_number_and_a_detection():
    seen = replace(frame(3, START_NS), trees=trees(5))  # the last one is not confirmed
    found = messages.map_messages(seen, path([0.0, 1.0, 2.0]))
    markers = decoded(messages.TREES, found[messages.TREES]).markers
    assert markers[0].action == 3, "first all of before is deleted"
    stems = [marker for marker in markers[1:] if marker.type == 3]
    assert [stem.id for stem in stems] == [1, 2, 3, 4]
    assert [stem.pose.position.x for stem in stems] == [0.0, 2.0, 4.0, 6.0]
    assert [stem.scale.x for stem in stems] == [0.3, 0.2, 0.3, 0.2], "where no diameter is known, a usual one"
    assert [m.text for m in markers if m.type == 9] == ["1: 30 cm", "2", "3: 30 cm", "4"]
    detections = decoded(messages.DETECTIONS, found[messages.DETECTIONS]).detections
    assert [each.id for each in detections] == ["1", "2", "3", "4"]
    assert [each.bbox.size.x for each in detections] == [0.3, 0.0, 0.3, 0.0]
    assert {each.results[0].hypothesis.class_id for each in detections} == {"tree"}
    assert detections[0].results[0].pose.covariance.reshape(6, 6)[0, 0] == 0.04
    assert len(decoded(messages.PATH, found[messages.PATH]).poses) == 3


@pytest.mark.parametrize("length", [0, 1, 999, 1000, 1001, 3333])
def test_a_long_path_is_thinned_and_ends_at_the_robot(length: int):
    found = messages.map_messages(frame(0, START_NS), path([float(k) for k in range(length)]))
    poses = decoded(messages.PATH, found[messages.PATH]).poses
    assert len(poses) <= messages.MOST_POSES
    assert len(poses) >= min(length, messages.MOST_POSES // 2)
    if length:
        assert poses[-1].pose.position.x == length - 1
    steps = {b.pose.position.x - a.pose.position.x for a, b in pairwise(poses)}
    assert len(steps) <= 1


def test_the_hash_of_a_type_is_that_of_ros():
    """The hash of std_msgs/String as ROS 2 prints it in `ros2 topic info --verbose`."""
    known = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert standard_types("cdr").hash_rihs01("std_msgs/msg/String") == known
    hashes = {messages.type_hash(topic) for topic in messages.TYPES}
    assert len(hashes) == len(set(messages.TYPES.values()))


@pytest.mark.parametrize(
    ("clearance", "told"),
    [
        (Clearance(Zone.STOP, 0.5, within=3.0), 0.5),
        (Clearance(Zone.CLEAR, within=3.0), np.inf),
        (Clearance(Zone.UNKNOWN, 0.5, within=3.0), np.nan),
    ],
)
def test_how_far_the_way_is_free_arrives(clearance: Clearance, told: float):
    found = messages.scan_messages(replace(frame(0, START_NS), clearance=clearance))
    way = decoded(messages.CLEARANCE, found[messages.CLEARANCE])
    assert (way.header.frame_id, way.max_range) == ("base_link", 3.0)
    np.testing.assert_equal(float(way.range), told)
    assert decoded(messages.ZONE, found[messages.ZONE]).data == int(clearance.zone)
    silent = messages.scan_messages(replace(frame(0, START_NS), clearance=None))
    assert silent.keys() == {messages.POSE, messages.ODOMETRY}
