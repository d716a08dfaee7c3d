"""Folders of stems that another program detected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.extensions.formats import tree_manager
from app.extensions.formats.tree_manager import (
    COLUMNS,
    _numbers,
    state_name,
    state_text,
    trajectory_text,
    write_tree_manager,
)
from pipeline.errors import SourceError
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import Source
from pipeline.types.records import Odometry, Scan, Stems
from pipeline.types.records import Path as MapPath
from tests.app import fakes
from tests.pipeline.io.conftest import Opened

NAN = float("nan")


def stem(x: float, y: float, z: float = -2.5, dbh: float = NAN) -> list[float | bool]:
    """A row of a frame's file."""
    return [*np.eye(3).ravel().tolist(), x, y, z, dbh, 0.3, 0.9, True, 4]


def poses(count: int) -> list[Pose3]:
    """Half a metre a step, tilted."""
    return [Pose3.from_euler(np.array([0.5 * k, 0.0, 1.0]), 0.1, -0.05, 0.02 * k) for k in range(count)]


def write(folder: Path, frames: int = 4, *, first: int = 0, rows: int | None = None) -> Path:
    """A sound folder with two stems a frame."""
    for k in range(frames):
        (folder / state_name(first + k)).write_text(
            state_text([stem(3.0 + k, 1.0, dbh=0.25), stem(-2.0, 4.0)])
        )
    count = frames if rows is None else rows
    (folder / "trajectory.txt").write_text(
        trajectory_text(100_000_000_000 + 500_000_000 * np.arange(count), poses(count))
    )
    return folder


def scans(source: Source) -> list[Scan]:
    """All scans of a source."""
    return [record for record in source.records() if isinstance(record, Scan)]


def stems(scan: Scan) -> Stems:
    """Those of a scan that must have some."""
    assert scan.stems is not None
    return scan.stems


def test_each_frame_is_a_scan_with_its_stems_and_its_pose(tmp_path: Path, opened: Opened):
    source = opened(write(tmp_path))
    known = source.description
    assert (known.scans, known.has_odometry, known.preset) == (4, True, "stems")
    assert (known.start_ns, known.end_ns) == (100_000_000_000, 101_500_000_000)
    odometry = [record for record in source.records() if isinstance(record, Odometry)]
    for pose, record in zip(poses(4), odometry, strict=True):
        np.testing.assert_allclose(record.T_odom_base.R, pose.R, atol=1e-8)
        np.testing.assert_allclose(record.T_odom_base.t, pose.t, atol=1e-8)
    for k, scan in enumerate(scans(source)):
        np.testing.assert_allclose(scan.points, [[3.0 + k, 1.0, -2.5], [-2.0, 4.0, -2.5]])
        np.testing.assert_allclose(stems(scan).axis, [[0, 0, 1], [0, 0, 1]])
        np.testing.assert_allclose(stems(scan).dbh, [0.25, NAN])
    assert source.losses == {}


def test_the_published_frames_are_those_of_the_whole_run(shared_data: Path, tmp_path: Path, opened: Opened):
    evo = np.load(shared_data / "oxford_evo" / "Evo.npz")
    for k in (0, 1):
        (tmp_path / state_name(k)).write_bytes((shared_data / "oxford_evo" / state_name(k)).read_bytes())
    table = evo["trajectory"][:2]
    told = [Pose3.from_quaternion(row[1:4], row[[7, 4, 5, 6]]) for row in table]
    (tmp_path / "trajectory.txt").write_text(
        trajectory_text(np.rint(table[:, 0] * 1e9).astype(np.int64), told)
    )
    source = opened(tmp_path)
    for k, scan in enumerate(scans(source)):
        rows = evo["frame"] == k
        np.testing.assert_array_equal(scan.points, evo["xyz"][rows])
        np.testing.assert_allclose(stems(scan).dbh, evo["dbh"][rows], rtol=1e-6)
        np.testing.assert_allclose(stems(scan).axis, evo["axis_z"][rows], atol=1e-6)
    assert source.losses == {}


def test_times_since_1970_come_back_to_the_nanosecond(tmp_path: Path, opened: Opened):
    stamps = 1_700_000_000_123_456_789 + 500_000_001 * np.arange(4)
    (write(tmp_path) / "trajectory.txt").write_text(trajectory_text(stamps, poses(4)))
    assert [scan.stamp_ns for scan in scans(opened(tmp_path))] == stamps.tolist()


def test_rows_without_a_file_are_odometry_alone(tmp_path: Path, opened: Opened):
    write(tmp_path, 5)
    (tmp_path / state_name(1)).unlink()
    source = opened(tmp_path)
    assert [scan.stamp_ns for scan in scans(source)] == [
        100_000_000_000 + k * 500_000_000 for k in (0, 2, 3, 4)
    ]
    assert len(list(source.records())) == 9
    assert "1 rows of trajectory.txt have no TreeManagerState file" in source.description.warnings[0]


def test_files_counted_from_one_are_rows_in_their_order(tmp_path: Path, opened: Opened):
    source = opened(write(tmp_path, first=1))
    assert [scan.points[0, 0] for scan in scans(source)] == [3.0, 4.0, 5.0, 6.0]
    assert source.description.start_ns == 100_000_000_000


def test_a_frame_without_stems_is_a_scan(tmp_path: Path, opened: Opened):
    write(tmp_path)
    (tmp_path / state_name(2)).write_text(state_text([]))
    assert [len(scan.points) for scan in scans(opened(tmp_path))] == [2, 2, 0, 2]


def test_columns_are_found_by_name_and_most_may_be_missing(tmp_path: Path, opened: Opened):
    write(tmp_path)
    (tmp_path / state_name(0)).write_text("score,location_z,location_x, location_y\r\n0.5,-1,2,3\r\n")
    first = scans(opened(tmp_path))[0]
    np.testing.assert_allclose(first.points, [[2.0, 3.0, -1.0]])
    assert np.isnan(stems(first).axis).all()
    assert np.isnan(stems(first).dbh).all()


@pytest.mark.parametrize(
    ("row", "kept"),
    [
        ("1,0,0,0,1,0,0,0,1,2,3,-1,0.2,0.2,1,True,4", True),
        (",,,,,,,,,2,3,-1,,,,False,", True),
        (",,,,,,,,,,3,-1,,,,False,4", False),
        (",,,,,,,,,2,3,-1,,,,maybe,4", False),
        (",,,,,,,,,2,3,inf,,,,True,4", False),
        (",,,,,,,,,2,3,-1,,,,True", False),
        ("\0\0\0", False),
    ],
)
def test_a_damaged_row_is_counted_and_the_others_stay(tmp_path: Path, opened: Opened, row: str, kept: bool):
    write(tmp_path)
    text = state_text([stem(1.0, 1.0), stem(2.0, 2.0)]).splitlines()
    (tmp_path / state_name(0)).write_text("\n".join([text[0], text[1], row, text[2]]) + "\n")
    source = opened(tmp_path)
    assert len(scans(source)[0].points) == 2 + kept
    assert source.losses == ({} if kept else {"damaged rows of TreeManagerState files": 1})


@pytest.mark.parametrize("dbh", [0.0, -0.3, NAN, 99.0])
def test_what_is_no_diameter_is_not_known(tmp_path: Path, opened: Opened, dbh: float):
    write(tmp_path)
    (tmp_path / state_name(0)).write_text(state_text([stem(1.0, 1.0, dbh=dbh)]))
    assert np.isnan(stems(scans(opened(tmp_path))[0]).dbh).all()


def test_an_axis_that_is_none_is_not_known_and_one_upside_down_is_turned(tmp_path: Path, opened: Opened):
    write(tmp_path)
    down, none = stem(1.0, 1.0), stem(2.0, 2.0)
    down[2], down[5], down[8] = 0.0, 0.6, -0.8
    none[8] = 0.0
    (tmp_path / state_name(0)).write_text(state_text([down, none]))
    np.testing.assert_allclose(
        stems(scans(opened(tmp_path))[0]).axis, [[0.0, -0.6, 0.8], [NAN, NAN, NAN]], atol=1e-12
    )


@given(st.lists(st.lists(st.floats(-1e3, 1e3) | st.just(NAN), min_size=17, max_size=17), max_size=5))
def test_what_is_written_is_read(rows: list[list[float | bool]]):
    _, _, body = state_text(rows).encode().partition(b"\n")
    table, damaged = _numbers(body, len(COLUMNS))
    assert damaged == 0
    np.testing.assert_allclose(table, np.array(rows, float).reshape(-1, 17), rtol=1e-8, atol=1e-12)


def test_frames_have_the_trees_that_were_seen_until_then_and_are_within_reach(tmp_path: Path):
    trees = replace(
        fakes.trees(3),
        position=np.array([[1.0, 3.0], [0.0, -3.9], [9.0, 9.0]]),
        first_seen_ns=np.array([0, 5, 0]),
        confirmed=np.ones(3, np.bool_),
    )
    path = MapPath(np.array([0, 10]), np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2))
    assert write_tree_manager(tmp_path / "out", path, trees, 4.0) == 1
    frames = [(tmp_path / "out" / state_name(k)).read_text().splitlines() for k in range(2)]
    assert [len(lines) - 1 for lines in frames] == [1, 2]


def test_a_written_map_is_read_as_trees_in_the_frame_of_each_pose(tmp_path: Path, opened: Opened):
    rng = np.random.default_rng(1)
    trees = replace(
        fakes.trees(5),
        position=rng.uniform(-9.0, 9.0, (5, 2)),
        first_seen_ns=np.zeros(5, np.int64),
        confirmed=np.ones(5, np.bool_),
    )
    x, y, yaw = rng.uniform(-3.0, 3.0, (3, 4))
    path = MapPath(10**9 * np.arange(4), x, y, yaw, np.zeros(4))
    assert write_tree_manager(tmp_path / "out", path, trees, 100.0) == 0
    records = list(opened(tmp_path / "out").records())
    poses = [record.T_odom_base for record in records if isinstance(record, Odometry)]
    np.testing.assert_allclose([pose.t for pose in poses], np.column_stack([x, y, np.zeros(4)]), atol=1e-8)
    read = [record for record in records if isinstance(record, Scan)]
    assert len(read) == 4
    for k, scan in enumerate(read):
        place = ((trees.position - [x[k], y[k]]) @ [1.0, 1.0j]) * np.exp(-1j * yaw[k])
        np.testing.assert_allclose(
            scan.points, np.column_stack([place.real, place.imag, np.zeros(5)]), atol=1e-5
        )
        np.testing.assert_allclose(stems(scan).axis, np.tile([0.0, 0.0, 1.0], (5, 1)))
        np.testing.assert_allclose(stems(scan).dbh, trees.dbh)


@given(st.binary(max_size=300))
def test_whatever_the_bytes_are_rows_are_whole_or_counted(body: bytes):
    table, damaged = _numbers(body, 3)
    assert table.shape[1] == 3
    assert damaged >= 0


def test_a_file_that_went_bad_on_the_way_is_counted(tmp_path: Path, opened: Opened):
    write(tmp_path)
    (tmp_path / state_name(2)).write_text("nothing of this kind\n1,2\n")
    source = opened(tmp_path)
    assert len(scans(source)) == 3
    assert source.losses == {"TreeManagerState files that cannot be read": 1}


# --- folders that are refused with one line -------------------------------------------------------


def refused(opened: Opened, folder: Path, *words: str) -> None:
    """Opening says what is wrong in one line."""
    with pytest.raises(SourceError) as caught:
        opened(folder)
    said = str(caught.value)
    assert "\n" not in said
    assert all(word in said for word in words), said


def test_a_missing_trajectory(tmp_path: Path, opened: Opened):
    (write(tmp_path) / "trajectory.txt").unlink()
    refused(opened, tmp_path, "no trajectory.txt", "time x y z qx qy qz qw")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "no rows"),
        ("1 0 0 0 0 0 0 one\n", "words"),
        ("1 0 0 0 0 0 0 nan\n", "finite"),
        ("1 0 0 0 0 0 0 0\n", "quaternion"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "ascend"),
        ("9999999999 0 0 0 0 0 0 1\n", "seconds"),
    ],
)
def test_a_damaged_trajectory(tmp_path: Path, opened: Opened, text: str, word: str):
    (write(tmp_path) / "trajectory.txt").write_text(text)
    refused(opened, tmp_path, "trajectory.txt cannot be used", word)


def test_more_files_than_rows(tmp_path: Path, opened: Opened):
    refused(opened, write(tmp_path, 4, rows=3), "has 3 rows", "numbered up to 3")


def test_another_header(tmp_path: Path, opened: Opened):
    (write(tmp_path) / state_name(0)).write_text("x,y,z\n1,2,3\n")
    refused(opened, tmp_path, "TreeManagerState_0.csv has no column location_x")


def test_a_huge_file(tmp_path: Path, opened: Opened, monkeypatch: pytest.MonkeyPatch):
    write(tmp_path)
    with (tmp_path / state_name(3)).open("r+b") as file:
        file.truncate(1 << 33)  # sparse
    refused(opened, tmp_path, "TreeManagerState_3.csv is larger than 16 MB")
    monkeypatch.setattr(tree_manager, "CSV_LIMIT", 1 << 40)
    (tmp_path / state_name(3)).write_text(state_text([]))
    with (tmp_path / "trajectory.txt").open("r+b") as file:
        file.truncate(1 << 33)
    refused(opened, tmp_path, "trajectory.txt cannot be used", "longer than")


def test_names_without_numbers(tmp_path: Path, opened: Opened):
    (tmp_path / "TreeManagerState_last.csv").write_text("")
    refused(opened, tmp_path, "TreeManagerState_<i>.csv")
