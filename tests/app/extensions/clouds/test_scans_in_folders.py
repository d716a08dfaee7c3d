"""Folders of scans in formats of whole clouds, written by other libraries."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import open3d as o3d
import pytest

import app.sources  # noqa: F401 - adds the formats
from app.extension import VARIABLE
from pipeline.errors import SourceError
from pipeline.io.readers import open_source
from pipeline.io.readers.point_files import ScanFileError, open_table, read_columns
from pipeline.types.records import Odometry, Scan
from tests.pipeline.io.test_kitti import curve, matrices
from tests.pipeline.io.test_scan_folders import points
from tests.pipeline.io.test_scan_folders import write as write_pcd


def write(path: Path, number: int) -> None:
    """One scan by a library that is not ours."""
    xyz = points(number)
    if path.suffix == ".npy":
        np.save(path, xyz.astype(np.float32))
    elif path.suffix == ".npz":
        np.savez(path, points=xyz)
    elif path.suffix == ".ply":
        o3d.io.write_point_cloud(path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz)))
    else:
        write_las(path, xyz)


def write_las(path: Path, xyz: np.ndarray, version: str = "1.2") -> None:
    las = laspy.LasData(laspy.LasHeader(point_format=0 if version == "1.2" else 6, version=version))
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = xyz.T
    las.write(str(path))


@pytest.mark.parametrize("suffix", [".ply", ".npy", ".npz", ".las", ".laz"])
def test_a_folder_of_any_format_is_a_run(suffix: str, tmp_path: Path):
    for number in range(4):
        write(tmp_path / f"{number:04d}{suffix}", number)
    (tmp_path / "poses.txt").write_text(matrices(curve(4)))
    source = open_source(str(tmp_path))
    records = list(source.records())
    scans = [record for record in records if isinstance(record, Scan)]
    poses = [record.T_odom_base for record in records if isinstance(record, Odometry)]
    assert [len(scan.points) for scan in scans] == [200] * 4
    np.testing.assert_allclose(scans[2].points, points(2), atol=2e-3)
    np.testing.assert_allclose([pose.t for pose in poses], [pose.t for pose in curve(4)], atol=1e-9)
    assert source.losses == {}


def test_a_damaged_scan_is_counted_and_the_others_are_read(tmp_path: Path):
    for k in range(3):
        write(tmp_path / f"{k}.laz", k)
    (tmp_path / "1.laz").write_bytes((tmp_path / "1.laz").read_bytes()[:100])
    source = open_source(str(tmp_path))
    assert sum(isinstance(record, Scan) for record in source.records()) == 2
    assert source.losses == {"scan files that cannot be read": 1}


def test_a_chunk_table_that_promises_more_than_the_file_has_is_damage(tmp_path: Path):
    for k in range(3):
        write_las(tmp_path / f"{k}.laz", points(k), "1.4")
    whole = bytearray((tmp_path / "1.laz").read_bytes())
    (table,) = struct.unpack_from("<q", whole, *struct.unpack_from("<I", whole, 96))  # offset of the points
    struct.pack_into("<I", whole, table + 4, 1000)  # chunks
    (tmp_path / "1.laz").write_bytes(whole)
    source = open_source(str(tmp_path))
    assert sum(isinstance(record, Scan) for record in source.records()) == 2
    assert source.losses == {"scan files that cannot be read": 1}


def test_a_zip_that_is_damaged_before_its_first_point_is_refused(tmp_path: Path):
    path = tmp_path / "cloud.npz"
    np.savez_compressed(path, points=np.random.default_rng(1).random((200_000, 3), np.float32))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ScanFileError, match="its data is damaged"):
        read_columns(open_table(path), {})


def test_a_folder_of_tiles_of_a_cloud_is_no_drive(tmp_path: Path):
    xyz = np.random.default_rng(2).uniform(-10.0, 10.0, (60_000, 3))
    for east in (False, True):
        write_las(tmp_path / f"plot_{int(east)}.laz", xyz[(xyz[:, 0] > 0.0) == east])
    with pytest.raises(SourceError, match=r"its 2 \.laz files are clouds or tiles of one"):
        open_source(str(tmp_path))


def test_scans_of_an_extension_that_is_switched_off_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    write(tmp_path / "000000.ply", 0)
    monkeypatch.setenv(VARIABLE, "")
    with pytest.raises(SourceError, match=r"needs an extension .*The extension clouds is switched off"):
        open_source(str(tmp_path))
    write_pcd(tmp_path / "000000.pcd", 0)
    assert open_source(str(tmp_path)).description.scans == 1
