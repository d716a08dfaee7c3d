"""A LiDAR without a recorded mounting is levelled by the ground in its first scan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.geometry.poses import Pose3
from pipeline.io.readers.base import Source, SourceOptions
from pipeline.io.readers.mounting import mounting_by_ground
from pipeline.io.readers.simulated import open_simulated
from pipeline.simulation.lidar import SolidStateLidar, SpinningLidar
from pipeline.types.records import Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import START_NS, Author, Write, write_recording
from tests.pipeline.io.test_scan_folders import save
from tests.pipeline.io.velodyne_drive import open_drive


def scan_of(scenario: str, lidar: SpinningLidar, mounting: Pose3) -> Scan:
    """The first scan of a scenario by a LiDAR at a place on the robot."""
    return replace(open_simulated(scenario).run, lidar=lidar, T_base_lidar=mounting).sweep(0).scan


def mounted(roll: float, pitch: float, height: float = 0.8) -> Pose3:
    """A mounting with roll and pitch [degrees]."""
    return Pose3.from_euler(np.array([0.0, 0.0, height]), np.radians(roll), np.radians(pitch), 0.0)


@pytest.mark.slow_after(5)
@pytest.mark.parametrize("scenario", ["sim:stand?duration=2", "sim:slope?duration=2", "sim:dense?duration=2"])
@pytest.mark.parametrize(("roll", "pitch"), [(180, 0), (0, 45), (90, 0), (-90, 0)])
@pytest.mark.parametrize("lidar", [SpinningLidar(), SolidStateLidar()], ids=["spinning", "solid"])
def test_a_tilted_lidar_is_levelled(scenario: str, roll: float, pitch: float, lidar: SpinningLidar):
    true = mounted(roll, pitch)
    found = mounting_by_ground(scan_of(scenario, lidar, true))
    assert found is not None
    assert np.degrees(np.arccos(found.R[2] @ true.R[2])) < 6.0
    assert found.t[2] == pytest.approx(0.8, abs=0.15)
    # x remains ahead
    assert np.degrees(np.arccos(min(1.0, float((found.R @ true.R.T)[0, 0])))) < 8.0


@pytest.mark.slow_after(9)
@pytest.mark.parametrize("scenario", ["sim:stand?duration=2", "sim:slope?duration=2", "sim:dense?duration=2"])
@pytest.mark.parametrize("height", [0.4, 0.8, 2.2])
@pytest.mark.parametrize("lidar", [SpinningLidar(), SolidStateLidar()], ids=["spinning", "solid"])
def test_an_upright_lidar_stays_so(scenario: str, height: float, lidar: SpinningLidar):
    assert mounting_by_ground(scan_of(scenario, lidar, mounted(0, 0, height))) is None


def test_a_lidar_that_looks_down_keeps_its_left_side():
    true = mounted(0, 90)
    found = mounting_by_ground(scan_of("sim:stand?duration=2", SolidStateLidar(), true))
    assert found is not None
    assert found.R[1, 1] > np.cos(np.radians(8.0))


def test_a_wall_beside_the_robot_is_not_the_ground():
    rng = np.random.default_rng(1)
    x, y, z = rng.uniform(-6.0, 6.0, (3, 600))
    floor = np.stack([x[:200], 0.2 * y[:200], np.full(200, -0.8)], axis=1)
    walls = np.stack([x[200:], np.where(rng.random(400) < 0.8, 1.2, -1.2), 0.2 * z[200:] + 0.4], axis=1)
    assert mounting_by_ground(Scan(0, np.vstack([floor, walls]).astype(np.float32))) is None


@pytest.mark.parametrize("number", [0, 1, 99, 300])
def test_without_ground_nothing_is_known(number: int):
    rng = np.random.default_rng(0)
    for points in (rng.uniform(-9.0, 9.0, (number, 3)), np.outer(np.linspace(1, 9, number), [1, 0, 0])):
        assert mounting_by_ground(Scan(0, points.astype(np.float32))) is None


@pytest.mark.parametrize("frame", ["velodyne", ""])
def test_a_recording_without_transforms_says_how_its_lidar_is_tilted(
    frame: str, tmp_path: Path, opened: Opened
):
    scan = scan_of("sim:stand?duration=2", SpinningLidar(), mounted(180, 0))

    def fill(author: Author, write: Write) -> None:
        table = np.zeros(len(scan.points), [(axis, "<f4") for axis in "xyz"])
        for k, axis in enumerate("xyz"):
            table[axis] = scan.points[:, k]
        write("/points", "sensor_msgs/msg/PointCloud2", START_NS, author.cloud(START_NS, table, frame))

    known = opened(write_recording("mcap", tmp_path, fill)).description
    assert known.T_base_lidar.R[2, 2] < -0.99
    (said,) = [text for text in known.warnings if "by the ground in the first scan" in text]
    assert (frame or "the LiDAR") in said
    assert "--mount" in said


def test_folders_of_scans_are_levelled_too(tmp_path: Path, opened: Opened):
    true = mounted(0, 45)
    run = open_drive("sim:stand?duration=2", 0.02, true)
    (tmp_path / "scans").mkdir()
    for k in range(2):
        save(tmp_path / "scans" / f"{k:06d}.pcd", run.sweep(k).scan.points)
    described = opened(tmp_path / "scans").description
    assert np.degrees(np.arccos(described.T_base_lidar.R[2] @ true.R[2])) < 6.0
    assert any("tilted by 4" in warning for warning in described.warnings)
    chosen = SourceOptions(T_base_lidar=mounted(0, 10))
    assert opened(tmp_path / "scans", chosen).description.T_base_lidar == chosen.T_base_lidar


def test_clutter_around_a_lidar_on_a_desk_is_no_ground():
    for seed in range(8):
        rng = np.random.default_rng(seed)
        beam = rng.normal(size=(8000, 3))
        beam /= np.linalg.norm(beam, axis=1)[:, None]
        beam[:, 2] *= 0.3  # rings of 17 degrees
        reach = rng.choice([0.4, 0.7, 2.5, 6.0], size=(8000, 1)) * rng.uniform(0.7, 1.3, size=(8000, 1))
        scan = Scan(0, (beam * reach).astype(np.float32))
        assert mounting_by_ground(scan) is None


def assert_not_levelled(source: Source) -> None:
    """No scan of a recording in a room has a mounting by the ground."""
    assert not any("tilted" in text for text in source.description.warnings)
    for record in source.records():
        if isinstance(record, Scan):
            assert mounting_by_ground(record) is None
            assert mounting_by_ground(record, np.radians(6.0)) is None


def test_no_lidar_is_levelled_by_the_things_in_a_room(shared_data: Path, opened: Opened):
    assert_not_levelled(opened(shared_data / "velodyne" / "vlp16_rosbag2"))
