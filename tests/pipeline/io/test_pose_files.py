"""Text files of poses: the names of their columns, their times and their encodings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.io.readers.pose_files import TextError, read_any_poses, read_times, time_ns
from tests.pipeline.io.test_kitti import curve, matrices

START_S = 1_645_000_000


@pytest.mark.parametrize(
    "head",
    [
        "time,x,y,theta,vx,vy,vz,wz",
        "time,x,y,z,roll,pitch,yaw,speed",
        "#time,lat,lon,alt,roll,pitch,yaw,fix",
        "# time px py pz rw rx ry rz",
        "time,x,y,z,q0,q1,q2,q3",
        "epoch,x,y,z,qx,qy,qz,qw",
        "seq,x,y,z,qx,qy,qz,qw",
        "time,stamp,x,y,z,qx,qy,qz,qw",
        "GPSTime,easting,northing,altitude,ve,vn,vu,roll,pitch,heading,wz,wy,wx",
    ],
)
def test_names_that_do_not_tell_time_and_pose_are_refused(head: str, tmp_path: Path):
    path = tmp_path / "poses.csv"
    row = f"{START_S},1,0,0,0,0,0,1" if head.count(",") != 12 else f"{START_S},1,0,0,1,0,1,0,1,0,0,1,0"
    path.write_text(f"{head}\n{row + ',0' if head.count(',') == 8 else row}\n")
    with pytest.raises(
        TextError, match=r"the names of its columns do not tell time and pose: .*(time|epoch|seq)"
    ):
        read_any_poses(path)


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("timestamp,seq,x,y,z,qx,qy,qz,qw", "{t},{k},{k},2,3,0,0,0,1"),
        ("x,y,z,qx,qy,qz,qw,t", "{k},2,3,0,0,0,1,{t}"),
        (
            "seq,header.stamp.secs,header.stamp.nsecs,frame,x,y,z,qx,qy,qz,qw,",
            "7,{s},{n},odom,{k},2,3,0,0,0,1,",
        ),
        ("time_s x y z qw qx qy qz", "{t} {k} 2 3 1 0 0 0"),
        ("# poses of the LiDAR", "{t} {k} 2 3 0 0 0 1"),
    ],
)
def test_the_time_is_the_column_with_its_name(head: str, row: str, tmp_path: Path):
    rows = [row.format(t=f"{START_S}.{k}", k=k, s=START_S, n=k * 10**8) for k in range(3)]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join([head, *rows]) + "\n")
    times, poses = read_any_poses(path)
    assert times is not None
    assert times.tolist() == [START_S * 10**9 + k * 10**8 for k in range(3)]
    np.testing.assert_allclose([pose.t for pose in poses], [[k, 2, 3] for k in range(3)])
    np.testing.assert_allclose([pose.R for pose in poses], [np.eye(3)] * 3)


def test_seven_named_columns_are_poses_without_times(tmp_path: Path):
    path = tmp_path / "poses.csv"
    path.write_text("qw,qx,qy,qz,x,y,z\n1,0,0,0,4,5,6\n")
    times, poses = read_any_poses(path)
    assert times is None
    assert poses[0].t.tolist() == [4.0, 5.0, 6.0]


def test_rows_that_contradict_their_names_are_refused(tmp_path: Path):
    path = tmp_path / "poses.csv"
    path.write_text("time,x,y,z,qx,qy,qz,qw,fix\n1,0,0,0,0,0,0,1\n")
    with pytest.raises(TextError, match="its rows do not have 9 numbers"):
        read_any_poses(path)


@pytest.mark.parametrize(
    ("w", "is_read"), [(1.0, True), (0.995, True), (0.98, False), (1.02, False), (0, False)]
)
def test_quaternions_have_the_length_1(w: float, is_read: bool, tmp_path: Path):
    path = tmp_path / "poses.txt"
    path.write_text(f"1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 {w}\n")
    if is_read:
        assert len(read_any_poses(path)[1]) == 2
    else:
        with pytest.raises(TextError, match="quaternions whose length is not 1"):
            read_any_poses(path)


def test_numbers_of_frames_are_no_times(tmp_path: Path):
    path = tmp_path / "poses.txt"
    path.write_text("".join(f"{k + 3} {row}\n" for k, row in enumerate(matrices(curve(4)).splitlines())))
    with pytest.raises(TextError, match="numbers of frames"):
        read_any_poses(path)


@pytest.mark.parametrize("end", ["", ".0", "."])
def test_nanoseconds_may_end_with_a_decimal_point(end: str):
    assert time_ns(f"1403636579763555584{end}") == 1_403_636_579_763_555_584
    assert time_ns(f"1403636579763555{end}") == 1_403_636_579_763_555_000


@pytest.mark.parametrize("word", ["8999999999999999999", "9300000000000000000", "1403636579763555584.5"])
def test_a_time_too_far_away_is_none(word: str, tmp_path: Path):
    with pytest.raises(ValueError, match="too far"):
        time_ns(word)
    path = tmp_path / "poses.txt"
    path.write_text(f"{word} 0 0 0 0 0 0 1\n")
    with pytest.raises(TextError, match="times are no seconds"):
        read_any_poses(path)


def test_a_byte_order_mark_is_no_number(tmp_path: Path):
    path = tmp_path / "poses.txt"
    path.write_text(f"{START_S}.5 1 0 0 0 0 0 1\n", "utf-8-sig")
    times, _ = read_any_poses(path)
    assert times is not None
    assert times.tolist() == [START_S * 10**9 + 5 * 10**8]
    path.write_text(matrices(curve(3)), "utf-8-sig")
    assert len(read_any_poses(path)[1]) == 3
    path.write_text(f"{START_S}.5\n", "utf-8-sig")
    assert read_times(path).tolist() == [START_S * 10**9 + 5 * 10**8]


def test_a_text_without_a_table_is_refused_by_its_columns(tmp_path: Path):
    path = tmp_path / "poses.txt"
    path.write_text("t0\nheader:\n  seq: 19844\n")
    with pytest.raises(TextError, match="its rows have 1 column; readable are"):
        read_any_poses(path)
