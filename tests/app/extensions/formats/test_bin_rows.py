"""Rows of .bin files are those of the data set that wrote them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.io.readers.point_files import MISSING, open_table
from pipeline.types.records import Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.test_scan_folders import points


def written(layout: str, xyz: np.ndarray) -> bytes:
    """Rows of a .bin file as data sets write them."""
    rng = np.random.default_rng(1)
    reflectance, ring = rng.uniform(0.0, 1.0, len(xyz)), np.arange(len(xyz)) % 32
    if layout == "NCLT":
        rows = np.zeros(len(xyz), [("xyz", "<u2", 3), ("i", "u1"), ("l", "u1")])
        xyz = xyz * [1.0, -1.0, -1.0]  # x ahead, y to the right, z down
        rows["xyz"], rows["i"], rows["l"] = np.rint((xyz + 100.0) / 0.005), 30, ring
        return rows.tobytes()
    further = {"KITTI": 0, "nuScenes": 1, "Boreas": 2}[layout]
    columns = [ring, -rng.uniform(0.0, 0.1, len(xyz))][:further]
    return np.column_stack([xyz, reflectance, *columns]).astype("<f4").tobytes()


@pytest.mark.parametrize("layout", ["KITTI", "nuScenes", "Boreas", "NCLT"])
def test_rows_of_bin_files_are_those_of_the_data_set(layout: str, tmp_path: Path, opened: Opened):
    for k in range(3):
        (tmp_path / f"{1_326_030_975_726_043 + k * 100_000}.bin").write_bytes(written(layout, points(k)))
    source = opened(tmp_path)
    assert source.description.kind == f"{layout} .bin"
    scans = [record for record in source.records() if isinstance(record, Scan)]
    np.testing.assert_allclose(scans[1].points, points(1), atol=3e-3)
    assert scans[1].stamp_ns - scans[0].stamp_ns == 10**8
    assert source.losses == {}


@pytest.mark.parametrize("layout", ["nuScenes", "Boreas", "NCLT"])
def test_a_cut_bin_file_keeps_its_layout(layout: str, tmp_path: Path, opened: Opened):
    path = tmp_path / "000000.bin"
    path.write_bytes(written(layout, points(0))[:-7])
    assert open_table(path).kind == f"{layout} .bin"
    source = opened(tmp_path)
    (scan,) = [record for record in source.records() if isinstance(record, Scan)]
    np.testing.assert_allclose(scan.points, points(0)[:-1], atol=3e-3)
    assert source.losses == {MISSING: 1}


@pytest.mark.parametrize("layout", ["KITTI", "nuScenes", "Boreas"])
def test_rows_of_nan_do_not_tell_the_layout(layout: str, tmp_path: Path):
    rows = points(0)
    rows[::20] = np.nan
    path = tmp_path / "000000.bin"
    path.write_bytes(written(layout, rows))
    assert open_table(path).kind == f"{layout} .bin"


def test_signalling_nan_gives_no_warning(tmp_path: Path):
    path = tmp_path / "000000.bin"
    path.write_bytes(4 * b"\x01\x00\x80\x7f" + written("KITTI", points(0)))
    assert open_table(path).kind == "KITTI .bin"


def test_a_few_rows_are_those_of_kitti(tmp_path: Path):
    path = tmp_path / "000000.bin"
    path.write_bytes(written("NCLT", points(0))[:24])
    table = open_table(path)
    assert (table.kind, table.points) == ("KITTI .bin", 2)
