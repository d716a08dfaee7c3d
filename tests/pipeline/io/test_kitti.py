"""Folders of .bin scans with files of poses and times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.geometry.poses import Pose3
from pipeline.io.readers import SourceOptions
from pipeline.io.readers.point_files import MISSING
from pipeline.io.readers.pose_files import R_LIDAR_CAMERA, read_any_poses
from pipeline.types.records import Odometry, Scan
from tests.pipeline.io.conftest import Opened


def write_scans(folder: Path, numbers: list[int]) -> None:
    """Scans of three points each, with one empty beam and one NaN."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        rows = np.array([[1 + number, 2, 3, 0.5], [4, 5, 6, 0.1], [0, 0, 0, 0], [np.nan, 1, 1, 1]], "<f4")
        (folder / f"{number:06d}.bin").write_bytes(rows.tobytes())


def matrices(poses: list[Pose3]) -> str:
    """Rows of 12 numbers."""
    return "".join(
        " ".join(f"{n:.12g}" for n in np.hstack([p.R, p.t[:, None]]).ravel()) + "\n" for p in poses
    )


def curve(count: int) -> list[Pose3]:
    """A LiDAR that drives a curve, 1 m a step."""
    step = Pose3.from_euler([1.0, 0.0, 0.0], 0.0, 0.0, 0.1)
    poses = [Pose3.identity()]
    for _ in range(count - 1):
        poses.append(poses[-1] @ step)
    return poses


@pytest.mark.parametrize("place", ["", "velodyne"])
@pytest.mark.parametrize(("scene", "count"), [("00", 23), ("02", 6), ("04", 7), ("06", 6)])
def test_park_trunks_stands_still_and_its_numbers_are_times(
    scene: str, count: int, place: str, shared_data: Path, opened: Opened
):
    source = opened(shared_data / "park_trunks" / scene / place)
    records = list(source.records())
    scans = [record for record in records if isinstance(record, Scan)]
    poses = [record for record in records if isinstance(record, Odometry)]
    assert source.description.scans == len(scans) == len(poses) == count
    assert source.description.has_odometry
    assert source.description.sensor.rings == 0
    for pose in poses:
        np.testing.assert_allclose(pose.T_odom_base.t, 0.0, atol=1e-6)
        np.testing.assert_allclose(pose.T_odom_base.R, np.eye(3), atol=1e-6)
    first, last = scans[0], scans[-1]
    assert last.stamp_ns - first.stamp_ns == (22 if scene == "00" else 5 * (count - 1)) * 100_000_000
    assert all(
        len(scan.points) + scan.dropped in (29952, 19968, 9984) and scan.dropped > 1000 for scan in scans
    )


def test_64_rings_are_recognised(shared_data: Path, opened: Opened):
    for name, points in (("kitti", [124668, 124605, 124478]), ("semantickitti", [123389])):
        source = opened(shared_data / name)
        scans = [record for record in source.records() if isinstance(record, Scan)]
        assert source.description.sensor.rings == 64
        assert not source.description.has_odometry
        assert [len(scan.points) for scan in scans] == points
        assert [scan.stamp_ns for scan in scans] == [100_000_000 * k for k in range(len(scans))]
    assert opened(shared_data / "kitti" / "000001.bin").description.scans == 1


def test_files_are_sorted_by_number_and_empty_beams_dropped(tmp_path: Path, opened: Opened):
    for number in (10, 9, 100):
        write_scans(tmp_path, [number])
        (tmp_path / f"{number:06d}.bin").rename(tmp_path / f"{number}.bin")
    source = opened(tmp_path)
    scans = [record for record in source.records() if isinstance(record, Scan)]
    assert [scan.points[0, 0] for scan in scans] == [10.0, 11.0, 101.0]
    assert [scan.dropped for scan in scans] == [2, 2, 2]
    assert [scan.stamp_ns for scan in scans] == [900_000_000, 1_000_000_000, 10_000_000_000]


@pytest.mark.parametrize("camera", [False, True])
def test_poses_are_those_of_the_lidar_however_they_are_written(camera: bool, tmp_path: Path):
    poses = curve(30)
    T_lidar_camera = Pose3(R_LIDAR_CAMERA, np.zeros(3))
    written = [T_lidar_camera.inverse() @ pose @ T_lidar_camera for pose in poses] if camera else poses
    path = tmp_path / "poses.txt"
    path.write_text(matrices(written))
    for read, expected in zip(read_any_poses(path)[1], poses, strict=True):
        np.testing.assert_allclose(read.t, expected.t, atol=1e-9)
        np.testing.assert_allclose(read.R, expected.R, atol=1e-9)


def test_the_calibration_beside_the_poses_is_used(tmp_path: Path):
    T_camera_lidar = Pose3(R_LIDAR_CAMERA.T, np.array([0.1, -0.2, -0.3]))
    poses = curve(10)
    (tmp_path / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: " + matrices([T_camera_lidar]))
    (tmp_path / "poses.txt").write_text(
        matrices([T_camera_lidar @ p @ T_camera_lidar.inverse() for p in poses])
    )
    for read, expected in zip(read_any_poses(tmp_path / "poses.txt")[1], poses, strict=True):
        np.testing.assert_allclose(read.t, expected.t, atol=1e-9)


def test_a_calibration_with_a_reflection_is_not_used(tmp_path: Path):
    (tmp_path / "calib.txt").write_text("Tr: 1 0 0 1 0 -1 0 2 0 0 1 3\n")
    (tmp_path / "poses.txt").write_text(matrices(curve(10)))
    for read, expected in zip(read_any_poses(tmp_path / "poses.txt")[1], curve(10), strict=True):
        np.testing.assert_allclose(read.t, expected.t, atol=1e-9)


def test_the_number_of_a_file_is_its_row(tmp_path: Path, opened: Opened):
    write_scans(tmp_path / "velodyne", [0, 5, 10])
    (tmp_path / "poses.txt").write_text(matrices(curve(12)))
    (tmp_path / "times.txt").write_text("".join(f"{0.2 * k:.6e}\n" for k in range(12)))
    mounting = Pose3.from_euler([0.5, 0.0, 1.0], 0.0, 0.0, 0.0)
    for path in (tmp_path, tmp_path / "velodyne"):
        records = list(opened(path, SourceOptions(T_base_lidar=mounting)).records())
        poses = [record for record in records if isinstance(record, Odometry)]
        assert [pose.stamp_ns for pose in poses] == [0, 1_000_000_000, 2_000_000_000]
        np.testing.assert_allclose((poses[1].T_odom_base @ mounting).t, curve(6)[5].t, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (matrices(curve(7)), "it has 7 rows"),
        ("1 2 3\n", "3 columns; readable are t x y z qx qy qz qw (TUM) or the 12 numbers"),
        ("nan " * 12, "finite"),
        ("1 " * 12, "rotations"),
        ("1 0 0 0 0 -1 0 0 0 0 1 0\n" * 11, "rotations"),
        ("x " * 12, "words"),
        ("", "no rows"),
    ],
)
def test_poses_that_do_not_fit_are_left_aside_with_a_warning(
    text: str, reason: str, tmp_path: Path, opened: Opened
):
    write_scans(tmp_path / "velodyne", [0, 5, 10])
    (tmp_path / "poses.txt").write_text(text)
    source = opened(tmp_path)
    assert not source.description.has_odometry
    assert reason in source.description.warnings[0]


@pytest.mark.parametrize(
    "text",
    [
        "2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.064389446\n",
        "1317042145.964389445\n1317042146.064389446\n",
    ],
)
@pytest.mark.parametrize("head", ["", "# times of the scans\n\n"])
def test_dates_and_seconds_are_times_to_the_nanosecond(head: str, text: str, tmp_path: Path, opened: Opened):
    write_scans(tmp_path, [0, 1])
    (tmp_path / "timestamps.txt").write_text(head + text)
    stamps = [record.stamp_ns for record in opened(tmp_path).records()]
    assert stamps == [1_317_042_145_964_389_445, 1_317_042_146_064_389_446]


def test_bad_files_among_good_ones_are_counted(tmp_path: Path, opened: Opened):
    write_scans(tmp_path, [0, 1, 2, 3])
    (tmp_path / "000001.bin").write_bytes(b"<html>not a scan</html>" * 40)
    (tmp_path / "000002.bin").write_bytes(b"")
    (tmp_path / "000003.bin").write_bytes((tmp_path / "000000.bin").read_bytes()[:-5])
    source = opened(tmp_path)
    assert len(list(source.records())) == 2
    assert source.losses == {
        "scan files that cannot be read": 1,
        "scans without points": 1,
        MISSING: 1,
    }
