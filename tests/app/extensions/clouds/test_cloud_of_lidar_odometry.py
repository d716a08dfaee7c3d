"""The cloud of a drive: the poses of LiDAR odometry are stored and used again."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.cli import main
from app.extensions.clouds.mapped_cloud import write_cloud
from pipeline.geometry.poses import Pose3
from pipeline.io.readers.pose_files import read_any_poses
from pipeline.io.result_files import ODOMETRY, tum_text
from pipeline.odometry.lidar_odometry import LidarOdometry

numbers = st.floats(-1e3, 1e3)
angles = st.floats(-1.5, 1.5)


@pytest.mark.slow
def test_the_cloud_of_a_run_with_lidar_odometry_registers_no_scan_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    folder = tmp_path / "run"
    assert main(["map", "sim:stand?duration=5", "--odometry", "lidar", "--out", str(folder)]) == 0
    times, poses = read_any_poses(folder / ODOMETRY)
    assert times is not None
    assert len(poses) == 50
    stored = (folder / ODOMETRY).read_bytes()
    (folder / ODOMETRY).unlink()
    write_cloud(folder, tmp_path / "registered.las")
    (folder / ODOMETRY).write_bytes(stored)

    def refuse(*_: object) -> None:
        raise AssertionError("a scan is registered again")

    monkeypatch.setattr(LidarOdometry, "_register", refuse)
    write_cloud(folder, tmp_path / "stored.las")
    first, second = (laspy.read(tmp_path / name) for name in ("registered.las", "stored.las"))
    assert abs(len(first) - len(second)) < 0.01 * len(first)
    for axis in "xyz":
        assert np.mean(first[axis]) == pytest.approx(np.mean(second[axis]), abs=0.02)


@given(st.integers(0, 2**61), numbers, numbers, angles, angles, angles)
def test_rows_of_poses_are_read_as_they_were(
    tmp_path_factory: pytest.TempPathFactory,
    stamp_ns: int, x: float, y: float, roll: float, pitch: float, yaw: float,
):  # fmt: skip
    pose = Pose3.from_euler(np.array([x, y, 0.5]), roll, pitch, yaw)
    file = tmp_path_factory.mktemp("poses") / ODOMETRY
    file.write_text(tum_text([(stamp_ns, pose), (stamp_ns + 1, pose)]))
    times, poses = read_any_poses(file)
    assert times is not None
    assert times.tolist() == [stamp_ns, stamp_ns + 1]
    np.testing.assert_allclose(poses[0].t, pose.t, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(poses[0].R, pose.R, atol=1e-7)
