"""Motion for sources without odometry: LiDAR odometry and files of poses."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from app.batch.map_run import OfflineRun, map_run
from app.cli import main
from app.sources.request import choose_odometry, with_odometry
from pipeline.config import preset
from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import open_source
from pipeline.io.readers.base import Source
from pipeline.io.readers.pose_files import between
from pipeline.io.readers.simulated import SimulatedSource
from pipeline.odometry.lidar_odometry import LidarOdometry, undistorted
from pipeline.odometry.odometry_override import TOO_FEW, TOO_MANY
from pipeline.types.records import Odometry, Record, Scan, Sensor
from tests.pipeline.io.test_kitti import curve, matrices
from tests.pipeline.io.test_scan_folders import tum, write

URI = "sim:stand?duration=6"


class NoWheels(SimulatedSource):
    """A simulated robot whose wheels tell nothing."""

    def __init__(self, inner: SimulatedSource) -> None:
        super().__init__(URI, inner.run)
        self._description = replace(self.description, has_odometry=False)

    def records(self, *, every: int = 1) -> Iterator[Record]:
        return (r for r in super().records(every=every) if not isinstance(r, Odometry))


def without_wheels() -> NoWheels:
    inner = open_source(URI)
    assert isinstance(inner, SimulatedSource)
    return NoWheels(inner)


def path_error(source: Source, choice: str) -> tuple[float, str]:
    """Largest distance [m] of the odometry from the true path at the scans, and what was chosen."""
    moving, chosen = with_odometry(source, choice)
    told = [record for record in moving.records() if isinstance(record, Odometry)]
    truth = source.truth()
    assert truth is not None
    assert truth.path is not None
    stamps = [odometry.stamp_ns for odometry in told]
    x, y = (np.interp(stamps, truth.path.stamp_ns, axis) for axis in (truth.path.x, truth.path.y))
    there = np.array([odometry.T_odom_base.t[:2] for odometry in told])
    return float(np.hypot(there[:, 0] - x, there[:, 1] - y).max()), chosen.words


@pytest.mark.slow
def test_scans_laid_over_one_another_tell_the_way():
    error, words = path_error(without_wheels(), "auto")
    assert error < 0.5
    assert words == "registration of the scans, because the source has no odometry"


@pytest.mark.slow
def test_wheels_say_where_the_search_begins():
    error, words = path_error(open_source(URI), "lidar")
    assert error < 0.3
    assert "started from the wheel odometry" in words


@pytest.mark.slow
def test_reading_again_gives_the_same_poses():
    moving, _ = with_odometry(without_wheels(), "lidar")
    poses = {}
    for record in moving.records():
        if isinstance(record, Odometry):
            poses[record.stamp_ns] = record.T_odom_base.t.tobytes()
            if len(poses) == 12:
                break
    again = {}
    for record in moving.records():
        if isinstance(record, Odometry):
            again[record.stamp_ns] = record.T_odom_base.t.tobytes()
            if len(again) == 25:
                break
    fresh, _ = with_odometry(without_wheels(), "lidar")
    straight = {r.stamp_ns: r.T_odom_base.t.tobytes() for r in fresh.records() if isinstance(r, Odometry)}
    assert {**poses, **again}.items() <= straight.items()
    assert len({**poses, **again}) > 20


@pytest.mark.slow
def test_the_map_without_wheels_is_close_to_the_map_with_them(tmp_path: Path):
    def mapped(source: Source, name: str) -> dict[str, object]:
        parameters = preset("forest")
        map_run(OfflineRun(source, "forest", parameters, 0, "auto"), tmp_path / name)
        record: dict[str, object] = json.loads((tmp_path / name / "run.json").read_text())
        return record

    without, with_wheels = mapped(without_wheels(), "without"), mapped(open_source(URI), "with")
    assert without["odometry_used"] == "registration of the scans, because the source has no odometry"
    assert with_wheels["odometry_used"] == "the source's own"
    for record in (without, with_wheels):
        assert isinstance(record["path_error"], dict)
        assert record["path_error"]["rms"] < 0.15
    assert abs(int(str(without["trees"])) - int(str(with_wheels["trees"]))) <= 3


def test_what_auto_chooses():
    known = open_source(URI).description
    alone = replace(known, has_odometry=False)
    assert choose_odometry(known, "auto").method == "source"
    assert choose_odometry(alone, "auto").method == "lidar"
    flat = replace(alone, sensor=Sensor(rings=1))
    assert choose_odometry(flat, "auto").method == "static"
    assert "planar laser" in choose_odometry(flat, "auto").warning
    assert choose_odometry(replace(alone, scans=1), "auto").method == "static"
    assert choose_odometry(replace(alone, preset="stems"), "auto").method == "static"
    with pytest.raises(SourceError, match="not possible"):
        choose_odometry(flat, "lidar")
    with pytest.raises(SourceError, match="no odometry"):
        choose_odometry(alone, "wheels")


def test_poses_from_a_file_are_told_at_the_scans(tmp_path: Path):
    (tmp_path / "scans").mkdir()
    for k in range(5):
        write(tmp_path / "scans" / f"{1_645_000_000}.{k}50000000.pcd", k)
    (tmp_path / "way.txt").write_text(tum(curve(5)))
    source, chosen = with_odometry(open_source(str(tmp_path / "scans")), f"file:{tmp_path / 'way.txt'}")
    assert chosen.method == "file"
    told = [record.T_odom_base for record in source.records() if isinstance(record, Odometry)]
    np.testing.assert_allclose(told[1].t, (curve(5)[1].t + curve(5)[2].t) / 2, atol=1e-9)
    assert told[1].euler()[2] == pytest.approx(0.15)
    assert "+" in source.description.digest
    with pytest.raises(SourceError, match="no poses can be read"):
        with_odometry(open_source(str(tmp_path / "scans")), f"file:{tmp_path / 'none.txt'}")
    (tmp_path / "way.txt").write_text("1 2 3\n")
    with pytest.raises(SourceError, match="3 columns; readable are t x y z") as refusal:
        with_odometry(open_source(str(tmp_path / "scans")), f"file:{tmp_path / 'way.txt'}")
    assert str(refusal.value).count("t x y z") == 1


@pytest.mark.parametrize("lost", [None, 2])
@pytest.mark.parametrize("rows", [3, 4, 5])
def test_rows_without_times_that_do_not_match_the_scans_are_told(tmp_path: Path, rows: int, lost: int | None):
    """A scan that cannot be read takes no row: the ones after it would have poses of others unnoticed."""
    scans = tmp_path / "scans"
    scans.mkdir()
    for k in range(4 if lost is None else 5):
        write(scans / f"{k:06d}.pcd", k)
    if lost is not None:
        (scans / f"{lost:06d}.pcd").write_bytes(b"no scan at all")
    (tmp_path / "way.txt").write_text(matrices(curve(rows)))
    source, _ = with_odometry(open_source(str(scans)), f"file:{tmp_path / 'way.txt'}")
    for _ in range(2):
        read = sum(isinstance(record, Scan) for record in source.records())
        assert read == 4
        told = {reason: n for reason, n in source.losses.items() if reason in (TOO_MANY, TOO_FEW)}
        assert told == ({} if rows == 4 else {TOO_MANY: 1} if rows > 4 else {TOO_FEW: 1})


def test_what_was_chosen_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for k in range(3):
        write(tmp_path / f"{k}.pcd", 0)
    assert main(["map", str(tmp_path), "--out", str(tmp_path / "out"), "--odometry", "file:"]) == 2
    assert main(["map", str(tmp_path), "--out", str(tmp_path / "out")]) == 3  # three scans without ground
    assert "odometry: registration of the scans" in capsys.readouterr().out


def test_points_are_moved_by_the_step_to_the_stamp():
    delta = np.eye(4)
    turned = Pose3.from_euler([1.0, 0.0, 0.0], 0.0, 0.0, 0.1)
    delta[:3, :3], delta[:3, 3] = turned.R, turned.t
    seen = np.array([[5.0, 2.0, 1.0]])
    # Half a step later the sensor stands half a step ahead; seen from the stamp the point lies farther.
    half = between(Pose3.identity(), turned, 0.5)
    found = undistorted(seen, np.array([0.05]), delta, 100_000_000)
    np.testing.assert_allclose(found, half.apply(seen), atol=0.02)
    assert undistorted(seen, None, delta, 100_000_000) is seen


def test_too_few_points_give_no_pose():
    source = without_wheels()
    moving, _ = with_odometry(source, "lidar")
    motion = LidarOdometry(Pose3.identity())
    few = Scan(1, np.ones((5, 3), np.float32))
    assert list(motion.add(few)) == [few]
    assert motion.losses == {"poses of scans with too few points for LiDAR odometry": 1}
    assert moving.description.has_odometry
