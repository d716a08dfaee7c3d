"""E57 clouds, written by pye57."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import SourceError
from pipeline.io.readers.clouds import is_cloud, open_cloud
from pipeline.io.readers.clouds.e57_pages import _HEADER, PAGE, Pages, checksums

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
    assert (cloud.description.points, cloud.description.kind) == (600, "E57, 2 stations")
    found = np.concatenate(list(cloud.parts())) + cloud.description.offset
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    assert cloud.losses == {}


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.95])
def test_a_cut_file_is_one_clear_error(keep: float, tmp_path: Path):
    write(tmp_path / "plot.e57")
    whole = (tmp_path / "plot.e57").read_bytes()
    (tmp_path / "plot.e57").write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(SourceError, match="E57"):
        list(open_cloud(str(tmp_path / "plot.e57")).parts())


def test_the_sums_are_those_that_the_library_writes_and_name_the_station_that_is_damaged(tmp_path: Path):
    path = tmp_path / "plot.e57"
    write(path, stations=3)
    pages, whole = Pages(path), path.read_bytes()
    assert (pages.damage, len(pages.sections)) == ("", 3)
    assert [pages.are_sound(station) for station in range(3)] == [True, True, True]
    second = pages.sections[1] + 3000
    path.write_bytes(whole[:second] + bytes([whole[second] ^ 1]) + whole[second + 1 :])
    assert not Pages(path).are_sound(1)
    assert Pages(path).are_sound(2)
    cloud = open_cloud(str(path))
    assert 0 < sum(len(part) for part in cloud.parts()) + sum(cloud.losses.values()) == 900
    path.write_bytes(whole[:-5] + b"\0" + whole[-4:])
    with pytest.raises(SourceError, match="E57 file is damaged: a checksum"):
        open_cloud(str(path))
    assert checksums(np.frombuffer(b"123456789", np.uint8)[None])[0] == 0xE3069283  # the sum of RFC 3720


def test_an_element_of_points_that_never_ends_is_passed_over_at_once(tmp_path: Path):
    """Going through it once an attribute would take hours."""
    xml = b"<points " + 100_000 * b'type="CompressedVector" '
    pages = -(-(_HEADER.size + len(xml)) // (PAGE - 4))
    head = _HEADER.pack(b"ASTM-E57", 1, 0, pages * PAGE, _HEADER.size, len(xml), PAGE)
    rows = np.frombuffer((head + xml).ljust(pages * (PAGE - 4), b"\0"), np.uint8).reshape(pages, -1)
    sums = checksums(rows).astype(">u4")[:, None].view(np.uint8)
    (tmp_path / "endless.e57").write_bytes(np.hstack([rows, sums]).tobytes())
    looked_at = Pages(tmp_path / "endless.e57")
    assert (looked_at.damage, looked_at.sections) == ("", ())
