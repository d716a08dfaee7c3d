"""Folders of scans in each format, written by other libraries, with files of times and poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import open_source
from pipeline.io.readers.base import COORDINATE_LIMIT
from pipeline.io.readers.pose_files import TextError, read_any_poses
from pipeline.types.records import Odometry, Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.test_kitti import curve, matrices

START_S = 1_645_000_000


def points(number: int) -> np.ndarray:
    """A scan of 200 points that differs from scan to scan."""
    rng = np.random.default_rng(number)
    return rng.uniform(-20.0, 20.0, (200, 3)).round(3)


def save(path: Path, xyz: np.ndarray) -> None:
    """A .bin or .pcd file of points."""
    if path.suffix == ".bin":
        np.hstack([xyz, np.zeros((len(xyz), 1))]).astype("<f4").tofile(path)
    else:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
        assert o3d.io.write_point_cloud(path, cloud)


def write(path: Path, number: int) -> None:
    """One scan, see `points`."""
    save(path, points(number))


def tum(poses: list[Pose3], first_s: float = START_S) -> str:
    """Rows t x y z qx qy qz qw, ten a second."""
    rows = []
    for k, pose in enumerate(poses):
        w, x, y, z = pose.quaternion()
        rows.append(
            f"{first_s + k // 10}.{k % 10}00000000 {pose.t[0]} {pose.t[1]} {pose.t[2]} {x} {y} {z} {w}"
        )
    return "# t x y z qx qy qz qw\n" + "\n".join(rows) + "\n"


@pytest.mark.parametrize("suffix", [".bin", ".pcd"])
def test_a_folder_of_any_format_is_a_run(suffix: str, tmp_path: Path, opened: Opened):
    for number in range(4):
        write(tmp_path / f"{number:04d}{suffix}", number)
    (tmp_path / "poses.txt").write_text(matrices(curve(4)))
    source = opened(tmp_path)
    records = list(source.records())
    scans = [record for record in records if isinstance(record, Scan)]
    poses = [record.T_odom_base for record in records if isinstance(record, Odometry)]
    assert [len(scan.points) for scan in scans] == [200] * 4
    np.testing.assert_allclose(scans[2].points, points(2), atol=2e-3)
    np.testing.assert_allclose([pose.t for pose in poses], [pose.t for pose in curve(4)], atol=1e-9)
    assert source.losses == {}


@pytest.mark.parametrize("stem", ["{s}.{d}00000000", "{s}{d}00000000", "cloud_{s}_{d}00000000"])
def test_names_may_be_times_and_rows_of_tum_belong_to_them(stem: str, tmp_path: Path, opened: Opened):
    for k in range(0, 8, 2):  # every other pose has a scan, and the last lies between two
        write(tmp_path / (stem.format(s=START_S, d=k) + ".pcd"), k)
    (tmp_path / "poses.txt").write_text(tum(curve(9)))
    source = opened(tmp_path)
    records = list(source.records())
    stamps = [record.stamp_ns for record in records if isinstance(record, Scan)]
    poses = [record.T_odom_base for record in records if isinstance(record, Odometry)]
    assert stamps == [START_S * 10**9 + k * 10**8 for k in range(0, 8, 2)]
    np.testing.assert_allclose([pose.t for pose in poses], [curve(9)[k].t for k in range(0, 8, 2)], atol=1e-9)


@pytest.mark.parametrize(
    "names",
    [
        [f"{START_S}.8", f"{START_S}.9", f"{START_S + 1}.0", f"{START_S + 1}.1"],
        ["a1", "b1", "a2", "b3"],
        ["first", "1", "2", "3"],
    ],
    ids=["times", "equal numbers", "one without a number"],
)
def test_names_that_do_not_number_the_scans_give_their_order_only(
    names: list[str], tmp_path: Path, opened: Opened
):
    for k, name in enumerate(names):
        write(tmp_path / f"{name}.pcd", k)
    (tmp_path / "poses.txt").write_text(matrices(curve(4)))
    records = list(opened(tmp_path).records())
    poses = [record.T_odom_base for record in records if isinstance(record, Odometry)]
    scans = [record for record in records if isinstance(record, Scan)]
    np.testing.assert_allclose([pose.t for pose in poses], [pose.t for pose in curve(4)], atol=1e-9)
    np.testing.assert_allclose([scan.points for scan in scans], [points(k) for k in range(4)], atol=1e-5)


def test_rows_of_tum_give_their_times_to_scans_without_any(tmp_path: Path, opened: Opened):
    for k in range(3):
        write(tmp_path / f"{k:06d}.pcd", k)
    (tmp_path / "trajectory.txt").write_text(tum(curve(3)))
    source = opened(tmp_path)
    assert source.description.has_odometry
    assert (source.description.start_ns, source.description.end_ns) == (
        START_S * 10**9,
        START_S * 10**9 + 2 * 10**8,
    )


def test_poses_of_another_time_are_left_aside_with_a_word(tmp_path: Path, opened: Opened):
    for k in range(3):
        write(tmp_path / f"{START_S}.{k}00000000.pcd", k)
    (tmp_path / "poses.txt").write_text(tum(curve(3), START_S + 5000))
    source = opened(tmp_path)
    assert not source.description.has_odometry
    assert "its times are not those of the scans" in source.description.warnings[0]


@pytest.mark.parametrize(
    "text",
    ["1 2 3\n", "1 0 0 0 0 0 0 0\n", "2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "nan 0 0 0 0 0 0 1\n", "\0\1\2"],
)
def test_poses_that_are_none_are_said(text: str, tmp_path: Path, opened: Opened):
    write(tmp_path / "0.pcd", 0)
    (tmp_path / "poses.txt").write_text(text)
    source = opened(tmp_path)
    assert not source.description.has_odometry
    assert source.description.warnings[0].startswith("poses.txt is not used")


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("write_poses", [tum, matrices])
def test_each_coordinate_of_a_position_is_bounded(
    axis: int, write_poses: Callable[[list[Pose3]], str], tmp_path: Path
):
    path = tmp_path / "poses.txt"
    for coordinate in (0.99 * COORDINATE_LIMIT, COORDINATE_LIMIT, -COORDINATE_LIMIT):
        poses = [Pose3.identity(), Pose3(np.eye(3), coordinate * np.eye(3)[axis])]
        path.write_text(write_poses(poses))
        if abs(coordinate) < COORDINATE_LIMIT:
            assert len(read_any_poses(path)[1]) == 2
        else:
            with pytest.raises(TextError, match="positions beyond"):
                read_any_poses(path)


def test_a_damaged_scan_is_counted_and_the_others_are_read(tmp_path: Path, opened: Opened):
    for k in range(3):
        write(tmp_path / f"{k}.pcd", k)
    (tmp_path / "1.pcd").write_bytes((tmp_path / "1.pcd").read_bytes()[:100])
    source = opened(tmp_path)
    assert sum(isinstance(record, Scan) for record in source.records()) == 2
    assert source.losses == {"scan files that cannot be read": 1}


def test_a_folder_of_broken_links_is_refused(tmp_path: Path, opened: Opened):
    (tmp_path / "velodyne").mkdir()
    (tmp_path / "velodyne" / "000000.bin").symlink_to(tmp_path / "missing.bin")
    with pytest.raises(SourceError, match=r"the folder has no \.bin files"):
        opened(tmp_path)


def drive_of_pcds(folder: Path, *, in_world: bool, views: bool) -> list[Pose3]:
    """Scans of a stand along a curve, as pcl_ros or a mapping program writes them; return the poses."""
    run = open_source("sim:stand?duration=6")
    scans = [record for record in run.records() if isinstance(record, Scan)][::6]
    poses = []
    for k, scan in enumerate(scans):
        pose = Pose3.from_euler((5.0 + 1.5 * k, -3.0 + 0.2 * k, 1.2), 0.0, 0.02, 0.1 * k)
        points = pose.apply(scan.points.astype(np.float64)) if in_world else scan.points
        table = np.zeros(len(points), [(name, "<f4") for name in ("x", "y", "z")])
        for axis, column in zip("xyz", points.T, strict=True):
            table[axis] = column
        place = " ".join(f"{value:.9g}" for value in (*pose.t, *pose.quaternion()))
        head = (
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
            f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT {place if views else '0 0 0 1 0 0 0'}\n"
            f"POINTS {len(points)}\nDATA binary\n"
        )
        (folder / f"{k:06d}.pcd").write_bytes(head.encode() + table.tobytes())
        poses.append(pose)
    np.save(folder / "first.points", scans[3].points)
    return poses


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("in_world", [False, True])
@pytest.mark.parametrize("views", [False, True])
def test_the_poses_in_the_headers_move_the_scans(in_world: bool, views: bool, tmp_path: Path, opened: Opened):
    """The poses are in the headers, or in a file; the points are those of the sensor, or of the world."""
    poses = drive_of_pcds(tmp_path, in_world=in_world, views=views)
    if not views:
        rows = [f"{k} {' '.join(map(str, pose.t))} {' '.join(map(str, np.roll(pose.quaternion(), -1)))}"
                for k, pose in enumerate(poses)]  # fmt: skip
        (tmp_path / "poses.txt").write_text("\n".join(rows))
    source = opened(tmp_path)
    assert source.description.has_odometry
    assert any("VIEWPOINT" in text for text in source.description.warnings) == views
    assert any("moved back" in text for text in source.description.warnings) == in_world
    records = list(source.records())
    odometry = [record for record in records if isinstance(record, Odometry)]
    scans = [record for record in records if isinstance(record, Scan)]
    for found, pose in zip(odometry, poses, strict=True):
        np.testing.assert_allclose(found.T_odom_base.t, pose.t, atol=1e-6)
        np.testing.assert_allclose(found.T_odom_base.R, pose.R, atol=1e-6)
    np.testing.assert_allclose(scans[3].points, np.load(tmp_path / "first.points.npy"), atol=1e-4)


def of_newer_college(poses: list[Pose3]) -> str:
    """Seconds and nanoseconds apart, the latter without leading zeros."""
    rows = [
        f"{START_S + (9 + k) // 10},{(9 + k) % 10 * 10**8 + 7},{','.join(map(str, p.t))},{x},{y},{z},{w}"
        for k, p in enumerate(poses)
        for w, x, y, z in [p.quaternion()]
    ]
    return "#sec,nsec,x,y,z,qx,qy,qz,qw\n" + "\n".join(rows) + "\n"


def of_wild_places(poses: list[Pose3]) -> str:
    """A header that is no comment."""
    return "timestamp,x,y,z,qx,qy,qz,qw\n" + tum(poses, START_S).partition("\n")[2].replace(" ", ",")


def of_euroc(poses: list[Pose3]) -> str:
    """Nanoseconds, and w before x, y, z."""
    head = "#timestamp [ns], " + ", ".join(
        [f"p_RS_R_{a} [m]" for a in "xyz"] + [f"q_RS_{a} []" for a in "wxyz"]
    )
    rows = [
        ", ".join(map(str, [START_S * 10**9 + k * 10**8, *p.t, *p.quaternion()])) for k, p in enumerate(poses)
    ]
    return "\n".join([head, *rows]) + "\n"


def of_mulran(poses: list[Pose3]) -> str:
    """Nanoseconds and a matrix."""
    rows = matrices(poses).splitlines()
    return "".join(f"{START_S * 10**9 + k * 10**8},{row.replace(' ', ',')}\n" for k, row in enumerate(rows))


@pytest.mark.parametrize("text", [of_newer_college, of_wild_places, of_euroc, of_mulran])
def test_poses_are_read_as_data_sets_write_them(text: Callable[[list[Pose3]], str], tmp_path: Path):
    path = tmp_path / "registered_poses.csv"
    path.write_text(text(curve(12)))
    times, poses = read_any_poses(path)
    assert times is not None
    assert (np.diff(times) == 10**8).all()
    np.testing.assert_allclose([p.t for p in poses], [p.t for p in curve(12)], atol=1e-9)
    np.testing.assert_allclose([p.R for p in poses], [p.R for p in curve(12)], atol=1e-9)


@pytest.mark.parametrize("place", [".", "Ouster/..", "data/../.."])
def test_a_folder_with_one_folder_of_scans_is_this_run(place: str, tmp_path: Path, opened: Opened):
    folder = tmp_path / "sequence" / "sensor_data" / "Ouster"
    folder.mkdir(parents=True)
    for k in range(12):  # nanoseconds without leading zeros
        write(folder / f"cloud_{START_S + (9 + k) // 10}_{(9 + k) % 10 * 10**8 + 7}.pcd", k)
    (tmp_path / "sequence" / "global_pose.csv").write_text(of_newer_college(curve(12)))
    source = opened({".": folder, "Ouster/..": folder.parent, "data/../..": tmp_path / "sequence"}[place])
    records = list(source.records())
    poses = [record.T_odom_base for record in records if isinstance(record, Odometry)]
    np.testing.assert_allclose([p.t for p in poses], [p.t for p in curve(12)], atol=1e-9)
    scans = [record.stamp_ns for record in records if isinstance(record, Scan)]
    assert (np.diff(scans) == 10**8).all()


def untimed(folder: Path, count: int) -> None:
    """Scans without times."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        write(folder / f"{k:06d}.bin", k)


def timed(folder: Path, count: int) -> None:
    """Scans with times in their names, ten a second."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        write(folder / f"{START_S}.{k}00000000.pcd", k)


@pytest.mark.parametrize(
    ("where", "given"),
    [("", "."), ("", "velodyne"), ("velodyne", "."), ("velodyne/deeper", "..")],
)
def test_a_relative_folder_has_its_poses(
    where: str, given: str, tmp_path: Path, opened: Opened, monkeypatch: pytest.MonkeyPatch
):
    untimed(tmp_path / "00" / "velodyne", 4)
    (tmp_path / "00" / "velodyne" / "deeper").mkdir()
    (tmp_path / "00" / "poses.txt").write_text(matrices(curve(4)))
    monkeypatch.chdir(tmp_path / "00" / where)
    assert opened(Path(given)).description.has_odometry


def test_a_linked_folder_has_the_poses_beside_the_link(tmp_path: Path, opened: Opened):
    untimed(tmp_path / "disk" / "scans", 4)
    (tmp_path / "00").mkdir()
    (tmp_path / "00" / "velodyne").symlink_to(tmp_path / "disk" / "scans")
    (tmp_path / "00" / "poses.txt").write_text(matrices(curve(4)))
    assert opened(tmp_path / "00" / "velodyne").description.has_odometry


@pytest.mark.parametrize("rows", [3, 5, 20])
def test_rows_of_a_text_found_by_its_name_are_as_many_as_the_scans(rows: int, tmp_path: Path, opened: Opened):
    """Rows at another rate have no scan; for the usual names the number of a scan is its row."""
    untimed(tmp_path, 4)
    (tmp_path / "odometry.csv").write_text(tum(curve(rows)))
    description = opened(tmp_path).description
    assert not description.has_odometry
    assert not description.has_times
    assert not any("odometry.csv" in text for text in description.warnings)
    (tmp_path / "odometry.csv").write_text(tum(curve(4)))
    description = opened(tmp_path).description
    assert description.has_odometry
    assert description.has_times
    assert "the motion is that in odometry.csv, which was found by its name" in description.warnings


def test_of_several_texts_with_the_same_steps_the_one_with_most_poses_is_used(tmp_path: Path, opened: Opened):
    untimed(tmp_path, 40)
    (tmp_path / "times.txt").write_text("".join(f"{START_S + k // 10}.{k % 10}\n" for k in range(40)))
    drifting = [Pose3(pose.R, 1.03 * pose.t + [9.0, 0.0, 0.0]) for pose in curve(16)]
    (tmp_path / "a_odom.csv").write_text(tum(drifting))
    (tmp_path / "b_odom.csv").write_text(tum(curve(40)))
    description = opened(tmp_path).description
    assert description.has_odometry
    assert "the motion is that in b_odom.csv, which was found by its name" in description.warnings


def test_several_texts_with_other_steps_are_not_chosen_from(tmp_path: Path, opened: Opened):
    timed(tmp_path, 4)
    (tmp_path / "gps_odom.csv").write_text(tum(curve(9)))
    (tmp_path / "lidar_odom.csv").write_text(tum([Pose3(pose.R, 1.3 * pose.t) for pose in curve(9)]))
    description = opened(tmp_path).description
    assert not description.has_odometry
    assert any("none of gps_odom.csv, lidar_odom.csv is used" in text for text in description.warnings)
    (tmp_path / "poses.txt").write_text(tum(curve(9)))
    description = opened(tmp_path).description
    assert description.has_odometry
    assert not any("odom.csv" in text for text in description.warnings)


def test_a_text_found_by_its_name_has_the_times_of_most_scans(tmp_path: Path, opened: Opened):
    folder = tmp_path / "sensor" / "lidar"
    folder.mkdir(parents=True)
    for k in range(8):
        write(folder / f"{START_S + k}.0.pcd", k)
    for place in (folder, tmp_path):
        text = place / "traj_a.txt"
        text.write_text(tum(curve(9), START_S + 6))
        assert not opened(folder).description.has_odometry
        text.write_text(tum(curve(90), START_S))
        assert opened(folder).description.has_odometry
        text.unlink()


@pytest.mark.parametrize("name", ["purpose.txt", "exposed_plots.csv", "odometer.md", "pose_notes.txt"])
@pytest.mark.parametrize("above", range(3))
def test_other_texts_are_not_mentioned(name: str, above: int, tmp_path: Path, opened: Opened):
    folder = tmp_path / "a" / "b"
    timed(folder, 3)
    before = opened(folder).description.warnings
    ([folder, *folder.parents][above] / name).write_text("1 2 3\n4 5 6\n")
    assert opened(folder).description.warnings == before


@pytest.mark.parametrize(
    "name", ["exposed.csv", "purpose.csv", "trajector.csv", "odometry.csv", "LIO_Odom-1.csv"]
)
def test_whole_words_tell_poses(name: str, tmp_path: Path, opened: Opened):
    timed(tmp_path, 3)
    (tmp_path / name).write_text(tum(curve(3)))
    assert opened(tmp_path).description.has_odometry == (name[:2] not in ("ex", "pu"))


def test_rows_two_folders_above_need_times(tmp_path: Path, opened: Opened):
    timed(tmp_path / "a" / "b", 4)
    (tmp_path / "poses.txt").write_text(matrices(curve(4)))
    assert not opened(tmp_path / "a" / "b").description.has_odometry
    (tmp_path / "poses.txt").write_text(tum(curve(4)))
    assert opened(tmp_path / "a" / "b").description.has_odometry


@pytest.mark.parametrize("first", [9_300_000_000_000_000_000, 8_999_999_999_999_999_000])
def test_names_too_far_away_in_time_are_numbers(first: int, tmp_path: Path, opened: Opened):
    for k in range(3):
        write(tmp_path / f"{first + k}.pcd", k)
    description = opened(tmp_path).description
    assert not description.has_times
    assert description.scans == 3


def test_numbers_of_frames_tell_the_scans_of_the_poses(tmp_path: Path, opened: Opened):
    """The layout of KITTI-360, where frames are missing and the poses are those of an IMU with z down."""
    drive = "2013_05_28_drive_0000_sync"
    scans = tmp_path / "data_3d_raw" / drive / "velodyne_points" / "data"
    scans.mkdir(parents=True)
    for number in range(3, 11):
        write(scans / f"{number:010d}.bin", number)
    T_imu_camera = Pose3(
        np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([1.5, 0, -0.6])
    )
    T_lidar_camera = Pose3(
        np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.8, 0.1, -0.2])
    )
    T_imu_lidar = T_imu_camera @ T_lidar_camera.inverse()
    calibration = tmp_path / "calibration"
    calibration.mkdir()
    (calibration / "calib_cam_to_pose.txt").write_text(
        f"image_00: {matrices([T_imu_camera])}image_01: {matrices([T_imu_camera])}"
    )
    (calibration / "calib_cam_to_velo.txt").write_text(matrices([T_lidar_camera]))
    poses = curve(12)
    frames = [4, 5, 7, 9, 11]
    rows = matrices([poses[k] @ T_imu_lidar.inverse() for k in frames]).splitlines()
    (tmp_path / "data_poses" / drive).mkdir(parents=True)
    (tmp_path / "data_poses" / drive / "poses.txt").write_text(
        "".join(f"{k} {row}\n" for k, row in zip(frames, rows, strict=True))
    )
    found = [record for record in opened(scans).records() if isinstance(record, Odometry)]
    assert [record.stamp_ns // 100_000_000 for record in found] == [4, 5, 7, 9]
    for record, k in zip(found, frames, strict=False):
        np.testing.assert_allclose(record.T_odom_base.t, poses[k].t, atol=1e-9)
        np.testing.assert_allclose(record.T_odom_base.R, poses[k].R, atol=1e-9)


def test_without_a_calibration_an_imu_has_only_other_axes(tmp_path: Path, opened: Opened):
    untimed(tmp_path, 4)
    turn = Pose3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    rows = matrices([pose @ turn for pose in curve(4)]).splitlines()
    (tmp_path / "poses.txt").write_text("".join(f"{k} {row}\n" for k, row in enumerate(rows)))
    found = [record for record in opened(tmp_path).records() if isinstance(record, Odometry)]
    np.testing.assert_allclose([record.T_odom_base.R for record in found], [p.R for p in curve(4)], atol=1e-9)


def test_numbers_of_other_frames_are_not_used(tmp_path: Path, opened: Opened):
    untimed(tmp_path, 4)
    rows = matrices(curve(4)).splitlines()
    (tmp_path / "poses.txt").write_text("".join(f"{k + 50} {row}\n" for k, row in enumerate(rows)))
    description = opened(tmp_path).description
    assert not description.has_odometry
    assert "poses.txt is not used: its frames are not those of the scans" in description.warnings
