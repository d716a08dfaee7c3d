"""The published pose of the odometry in a stored map."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from app.extensions.maps.localisation import Localisation, State
from app.extensions.maps.localise import in_stored_map, map_odom
from pipeline.geometry.poses import Pose2
from pipeline.io.readers.topics import standard_types
from pipeline.types.records import Frame, Path, PoseEstimate
from tests.app.extensions.maps.localisation.stands import trees_at

T_MAP_RUN = Pose2(10.0, -5.0, 0.7)
BASE, ODOM = Pose2(3.0, 1.0, 0.2), Pose2(2.5, 1.5, -0.1)
FOUND = Localisation(State.FOUND, T_MAP_RUN, np.diag([0.01, 0.02, 1e-4]), 14, 16)


def frame() -> Any:
    """What a scan gives: the pose in the run, that by odometry, and the trees."""
    estimate = PoseEstimate(BASE, np.eye(3), np.zeros((1, 3)), np.ones(1), 1.0, np.zeros((0, 2)))
    return SimpleNamespace(stamp_ns=5_000_000_000, estimate=estimate, T_odom_base=ODOM)


def test_odom_then_base_gives_the_robot_in_the_map():
    (content,) = map_odom(frame(), FOUND).values()
    message: Any = standard_types("cdr").deserialize_cdr(content, "nav_msgs/msg/Odometry")
    assert (message.header.frame_id, message.child_frame_id) == ("map", "odom")
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    T_map_odom = Pose2(at.x, at.y, 2.0 * float(np.arctan2(turn.z, turn.w)))
    robot, expected = T_map_odom @ ODOM, T_MAP_RUN @ BASE
    assert robot.as_array() == pytest.approx(expected.as_array(), abs=1e-9)
    covariance = message.pose.covariance.reshape(6, 6)
    assert covariance[5, 5] == pytest.approx(1e-4)
    assert covariance[0, 0] > 0.01  # farther from the robot, by its heading


def test_nothing_is_published_before_it_is_found():
    assert map_odom(frame(), Localisation()) == {}
    nothing = Path(np.zeros(0, np.int64), *(np.zeros(0) for _ in range(4)))
    assert in_stored_map(frame(), nothing, Localisation()) is None


def test_pose_trees_and_path_move_into_the_map():
    position = np.array([[1.0, 2.0], [4.0, -1.0]])
    one = SimpleNamespace(**vars(frame()), trees=trees_at(position))
    fields: dict[str, Any] = {name: getattr(one, name, None) for name in Frame.__dataclass_fields__}
    whole = Frame(**fields)
    path = Path(np.array([1]), np.array([3.0]), np.array([1.0]), np.array([0.2]), np.array([0.1]))
    moved = in_stored_map(whole, path, FOUND)
    assert moved is not None
    there, along = moved
    assert there.estimate.T_map_base == T_MAP_RUN @ BASE
    np.testing.assert_allclose(there.trees.position, T_MAP_RUN.apply(position))
    assert np.all(
        there.trees.covariance[:, [0, 1], [0, 1]] > replace(one.trees).covariance[:, [0, 1], [0, 1]]
    )
    np.testing.assert_allclose([along.x[0], along.y[0]], T_MAP_RUN.apply(np.array([[3.0, 1.0]]))[0])
