"""E57 clouds, written by pye57."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from app.sources.one_step import is_one_step as is_cloud
from pipeline.errors import SourceError
from tests.app.extensions.formats.conftest import open_cloud

pye57 = pytest.importorskip("pye57", reason="pye57 is an extra")


def write(path: Path, stations: int = 2) -> np.ndarray:
    """So many stations 10 m apart in UTM coordinates, each turned; all points in the frame of the file."""
    rng = np.random.default_rng(1)
    file = pye57.E57(str(path), mode="w")
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    everything = []
    for k in range(stations):
        own = rng.uniform(-5.0, 5.0, (300, 3))
        t = np.array([450_000.0 + 10.0 * k, 6_800_000.0, 120.0])
        columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), own.T.copy(), strict=True))
        turn = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
        file.write_scan_raw(columns, rotation=turn, translation=t)
        everything.append(own @ R.T + t)
    file.close()
    return np.concatenate(everything)


def test_all_stations_stand_in_the_frame_of_the_file(tmp_path: Path):
    wanted = write(tmp_path / "plot.e57")
    cloud = open_cloud(str(tmp_path / "plot.e57"))
    assert is_cloud(str(tmp_path / "plot.e57"))
    assert (cloud.about.points, cloud.description.kind) == (600, "whole cloud, E57, 2 stations")
    found = np.concatenate(list(cloud.points()))
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    assert cloud.losses == {}


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.95])
def test_a_cut_file_is_one_clear_error(keep: float, tmp_path: Path):
    write(tmp_path / "plot.e57")
    whole = (tmp_path / "plot.e57").read_bytes()
    (tmp_path / "plot.e57").write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(SourceError, match="E57"):
        list(open_cloud(str(tmp_path / "plot.e57")).points())


def test_a_damaged_page_is_one_clear_error_or_a_counted_loss(tmp_path: Path):
    path = tmp_path / "plot.e57"
    write(path, stations=3)
    whole = path.read_bytes()
    path.write_bytes(whole[:-5] + b"\0" + whole[-4:])
    with pytest.raises(SourceError, match=r"E57 file is damaged: .*(?i:checksum)"):
        open_cloud(str(path))
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    cloud = open_cloud(str(path))
    read = sum(len(part) for part in cloud.points())
    assert 0 < read < 900
    assert cloud.losses == {"points that the files promise but do not hold": 900 - read}
