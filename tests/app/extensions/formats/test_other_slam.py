"""Poses of another SLAM system: alignment of their frame, refused covariances, and their effect on the
path."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.extensions.formats.other_slam import GATE, OtherPose, align_poses
from pipeline.config import preset
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.io.readers import SourceOptions
from pipeline.io.readers.message_formats import UnusableReadingError
from pipeline.odometry.synchroniser import steps
from pipeline.slam import FastSlam, Motion
from pipeline.slam.measured_pose import within_gate
from pipeline.slam.motion import noise_of
from pipeline.types.records import PoseMeasurement
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, STEP_NS, Author, Write, write_recording
from tests.pipeline.io.test_more_ros import laser
from tests.pipeline.strategies import ALL_FREE, detections

T_THEIRS_ODOM = Pose2(50.0, -20.0, 2.1)
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
STEPS, STRIDE = 90, 0.5
SIGMA = (0.05, 0.01)
NAMED = SourceOptions(topics={"pose": "/other/pose"})
JUMP_AT = 80


def covariance(xy: float = SIGMA[0], yaw: float = SIGMA[1]) -> list[float]:
    return np.diag([xy**2, xy**2, 1.0, 1.0, 1.0, yaw**2]).ravel().tolist()


@given(x=st.floats(-99.0, 99.0), y=st.floats(-99.0, 99.0), yaw=st.floats(-3.1, 3.1), seed=st.integers(0, 99))
def test_any_frame_is_found_again(x: float, y: float, yaw: float, seed: int):
    rng = np.random.default_rng(seed)
    way, T_theirs_map = [Pose2()], Pose2(x, y, yaw)
    for turn in rng.normal(0.0, 0.05, 40):
        way.append(way[-1] @ Pose2(0.4, 0.0, float(turn)))
    stamps = [k * STEP_NS for k in range(len(way))]
    placed = []
    for stamp_ns, pose in zip(stamps, way, strict=True):
        at = T_theirs_map @ pose
        told = Pose3.from_euler(np.array([at.x, at.y, 3.0]), 0.0, 0.0, at.yaw)
        placed.append(OtherPose.of(stamp_ns, told, covariance()))
    found, why = align_poses(placed, stamps, np.array([pose.as_array() for pose in way]))
    assert found is not None, why
    assert found.measurement(placed[3]) is None, "it counts when the stretch is over"
    at = T_theirs_map @ Pose2(30.0, 4.0, 0.3)
    later = OtherPose.of(
        10**11, Pose3.from_euler(np.array([at.x, at.y, 0.0]), 0.0, 0.0, at.yaw), covariance()
    )
    measured = found.measurement(later)
    assert measured is not None
    assert measured.is_sound()
    np.testing.assert_allclose(measured.T_map_base.as_array(), [30.0, 4.0, 0.3], atol=1e-6)


@pytest.mark.parametrize("entry", [0.0, -1.0, np.nan, np.inf])
def test_a_covariance_that_is_none_is_refused(entry: float):
    for row in (0, 1, 5):
        C = np.array(covariance()).reshape(6, 6)
        C[row, row] = entry
        with pytest.raises(UnusableReadingError):
            OtherPose.of(0, Pose3.identity(), C.ravel().tolist())


def drive(author: Author, write: Write, *, frame: str = "map", jump: float = 0.0) -> None:
    """Straight ahead; the wheels turn to the left by and by, the other SLAM knows better. Every tenth of its
    poses has a covariance of zeros; it may jump in the end."""
    rng = np.random.default_rng(5)
    wheels = Pose2()
    for step in range(STEPS):
        stamp_ns = START_NS + step * STEP_NS
        true = Pose2(STRIDE * step + (jump if step >= JUMP_AT else 0.0), 0.0, 0.0)
        wheels = wheels if step == 0 else wheels @ Pose2(STRIDE, 0.0, 0.004)
        odometry: Any = author.odometry(stamp_ns, wheels.x, wheels.yaw)
        odometry.pose.pose.position.y = wheels.y
        write("/odom", "nav_msgs/msg/Odometry", stamp_ns, odometry)
        told = T_THEIRS_ODOM @ true
        noise = rng.normal(0.0, [SIGMA[0], SIGMA[0], SIGMA[1]])
        at, turn = author.pose(told.x + noise[0], told.y + noise[1], 0.0, told.yaw + noise[2])
        pose = author.make("Pose", author.make("Point", at.x, at.y, at.z), turn)
        spread = np.zeros(36) if step % 10 == 5 else np.array(covariance())
        message = author.make(
            "PoseWithCovarianceStamped",
            author.header(stamp_ns - STEP_NS // 2, frame),
            author.make("PoseWithCovariance", pose, spread),
        )
        back = T_THEIRS_ODOM @ Pose2(true.x - 0.5 * STRIDE, 0.0, 0.0)  # it was measured half a step before
        message.pose.pose.position.x += back.x - told.x
        message.pose.pose.position.y += back.y - told.y
        write("/other/pose", POSE, stamp_ns, message)
        write("/scan", "sensor_msgs/msg/LaserScan", stamp_ns, laser(author, stamp_ns))


def mapped(source: Any, *, use: bool) -> tuple[np.ndarray, int]:
    """x, y, yaw of each scan by the filter, without a tree in view, and how many poses were refused."""
    p = preset("forest").slam
    slam, before, refused = FastSlam(p, 0), None, 0
    last = (Pose2(), np.zeros((3, 3)))
    poses = []
    for step in steps(source.records(), losses=Counter()):
        now = step.T_odom_base
        assert now is not None
        motion = Motion(
            Pose2() if before is None else before.inverse() @ now, measured=step.measured if use else None
        )
        before = now
        if not within_gate(*last, motion, noise_of(p)):
            motion, refused = motion._replace(measured=None), refused + 1
        estimate = slam.process(step.index, motion, detections(np.zeros((0, 2))), ALL_FREE)
        last = (estimate.T_map_base, estimate.covariance)
        poses.append(last[0].as_array())
    return np.array(poses), refused


def test_poor_wheels_are_put_right_by_a_good_slam(tmp_path: Path, opened: Opened):
    source = opened(write_recording("mcap", tmp_path, drive), NAMED)
    assert "poses are used" in source.description.other_slam
    with_it, refused = mapped(source, use=True)
    assert source.losses == {"poses of another SLAM: a covariance is zero or not positive definite": 9}
    alone, _ = mapped(source, use=False)
    true = np.column_stack([STRIDE * np.arange(STEPS), np.zeros(STEPS)])
    error = with_it[:, :2] - true
    rms = np.sqrt(np.square(error).sum(axis=1).mean())
    assert refused == 0
    assert rms < 0.4 * np.sqrt(np.square(alone[:, :2] - true).sum(axis=1).mean())


def test_a_jump_of_the_other_slam_moves_nothing(tmp_path: Path, opened: Opened):
    source = opened(write_recording("mcap", tmp_path, lambda a, w: drive(a, w, jump=8.0)), NAMED)
    poses, refused = mapped(source, use=True)
    assert refused == 9  # one of the ten has no covariance
    assert abs(poses[-1, 0] - STRIDE * (STEPS - 1)) < 2.0


def test_poses_that_nobody_named_do_not_count(tmp_path: Path, opened: Opened):
    path = write_recording("mcap", tmp_path, drive)
    source = opened(path)
    assert source.description.other_slam == ""
    assert {t.why_not for t in source.description.topics if t.name == "/other/pose"} == {
        "it is read when it is named as pose"
    }
    assert not any(isinstance(record, PoseMeasurement) for record in source.records())
    measured = [record for record in opened(path, NAMED).records() if isinstance(record, PoseMeasurement)]
    assert measured
    assert all(pose.gate == GATE for pose in measured)
