"""A file of points is a whole cloud or one scan by what it holds, and the user can say which."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from app.cli import main
from app.extensions.clouds.point_cloud import open_cloud
from app.extensions.clouds.sources import takes as is_cloud_in_child
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import form_of, open_source
from pipeline.io.readers.base import SourceOptions
from pipeline.types.records import Scan
from tests.pipeline.plots import plot


def pcd(
    path: Path, points: np.ndarray, *, extra: str = "", view: str = "0 0 0 1 0 0 0", height: int = 1
) -> str:
    """A binary PCD file of x, y, z and, where named, another column of zeros."""
    names = ["x", "y", "z", *([extra] if extra else [])]
    table = np.zeros(len(points), [(name, "<f4") for name in names])
    for axis, column in zip("xyz", points.T, strict=True):
        table[axis] = column
    n = len(names)
    head = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(names)}\nSIZE{' 4' * n}\nTYPE{' F' * n}\n"
        f"COUNT{' 1' * n}\nWIDTH {len(points) // height}\nHEIGHT {height}\nVIEWPOINT {view}\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    path.write_bytes(head.encode() + table.tobytes())
    return str(path)


def is_cloud(file: str, options: SourceOptions | None = None) -> bool:
    """Whether a file is opened as a whole cloud."""
    return form_of(Path(file), options or SourceOptions()).is_cloud


def sweeps(uri: str, count: int = 2) -> list[np.ndarray]:
    """The points of some simulated scans."""
    found = [record.points for record in open_source(uri).records() if isinstance(record, Scan)]
    return [np.asarray(points, float) for points in found[:: max(1, len(found) // count)][:count]]


@pytest.fixture(scope="module")
def points():
    return plot(np.random.default_rng(1), per_m2=900)


@pytest.fixture(scope="module")
def sweep():
    return sweeps("sim:wild?duration=1", 1)[0]


def lio_map(points: np.ndarray) -> np.ndarray:
    """A map whose origin is the first pose of the LiDAR, in the plot and not levelled."""
    tilt = Pose3.from_euler((0.0, 0.0, 0.0), np.radians(3.0), np.radians(-2.0), 0.5).R
    return (points - [7.0, 6.0, 1.1]) @ tilt.T


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_map_of_a_lio_is_a_cloud(tmp_path, points, share):
    chosen = lio_map(points)[np.random.default_rng(2).random(len(points)) < share]
    file = pcd(tmp_path / "scans.pcd", chosen, extra="curvature")
    assert is_cloud(file)
    assert is_cloud_in_child(file)
    (words,) = [text for text in open_cloud(file).description.warnings if "taken as" in text]
    assert "taken as a whole cloud, because" in words
    assert "--as scan" in words


def test_coordinates_of_a_country_and_many_points_are_a_cloud(tmp_path, sweep):
    place = np.array([450_000.0, 5_200_000.0, 300.0])
    assert is_cloud(pcd(tmp_path / "a.pcd", sweep + place))
    assert is_cloud(pcd(tmp_path / "b.pcd", np.tile(sweep, (30, 1))))


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("uri", ["sim:wild?duration=1", "sim:dense?duration=1", "sim:stand?duration=1"])
@pytest.mark.parametrize("thinned", [0.0, 0.05, 0.1])
def test_a_sweep_is_a_scan(tmp_path, uri, thinned):
    for points in sweeps(uri):
        if thinned:
            first = np.unique(np.floor(points / thinned), axis=0, return_index=True)[1]
            points = points[np.sort(first)]
        assert not is_cloud(pcd(tmp_path / "scan.pcd", points))


def test_a_sweep_of_nclt_is_a_scan(tmp_path, sweep):
    rows = np.zeros(len(sweep), [("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
    rows["xyz"] = np.rint((sweep * [1.0, -1.0, -1.0] + 100.0) / 0.005)
    path = tmp_path / "1326030975726043.bin"
    path.write_bytes(rows.tobytes())
    assert not is_cloud(str(path))


def test_columns_and_rows_of_a_sensor_are_a_scan(tmp_path, points, sweep):
    half = len(sweep) // 2 * 2
    assert not is_cloud(pcd(tmp_path / "a.pcd", sweep, extra="ring"))
    assert not is_cloud(pcd(tmp_path / "b.pcd", sweep[:half], height=2))
    table = np.zeros(len(points), [("x", "f4"), ("y", "f4"), ("z", "f4")])
    np.save(tmp_path / "c.npy", table)
    assert is_cloud(str(tmp_path / "c.npy"))
    np.save(tmp_path / "d.npy", np.zeros(100, [*table.dtype.descr, ("ring", "u2")]))
    assert not is_cloud(str(tmp_path / "d.npy"))


@pytest.mark.slow
def test_real_scans_and_clouds(shared_data, tmp_path):
    scans = [
        *shared_data.glob("velodyne/**/*.pcd"),
        *shared_data.glob("hesai/**/*.pcd"),
        *shared_data.glob("sloam_forest/*.pcd"),
        *sorted(shared_data.glob("park_trunks/*/velodyne/*.bin"))[::20],
        *shared_data.glob("kitti/**/*.bin"),
    ]
    assert len(scans) > 10
    assert [file.name for file in scans if is_cloud(str(file))] == []
    for name in ("pine_plot", "LPine1_demo", "MLS_Clip"):
        cloud = np.concatenate(list(open_cloud(str(shared_data / "forest" / f"{name}.laz")).parts()))
        some = cloud[np.random.default_rng(1).random(len(cloud)) < 90_000 / len(cloud)].astype(float)
        origin = np.append(np.median(some[:, :2], axis=0), np.percentile(some[:, 2], 5.0) + 1.2)
        assert is_cloud(pcd(tmp_path / "plot.pcd", some - origin)), name


@pytest.mark.slow
def test_the_choice_of_the_user_counts_and_the_decision_is_said(tmp_path, points, sweep, capsys):
    cloud = pcd(tmp_path / "map.pcd", lio_map(points))
    scan = pcd(tmp_path / "scan.pcd", sweep)
    for file, other in ((cloud, "scan"), (scan, "cloud")):
        assert is_cloud(file, SourceOptions(form=other)) == (other == "cloud")
        assert is_cloud_in_child(file, SourceOptions(form=other)) == (other == "cloud")
    assert main(["map", cloud, "--out", str(tmp_path / "a")]) == 0
    assert "taken as a whole cloud, because" in capsys.readouterr().err
    record = json.loads((tmp_path / "a" / "run.json").read_text())
    assert record["trees"] == 9
    assert "chosen" not in record
    assert main(["map", scan, "--out", str(tmp_path / "b")]) == 0
    told = capsys.readouterr().err
    assert "taken as one scan, because" in told
    assert "--as cloud" in told
    assert main(["map", cloud, "--as", "scan", "--out", str(tmp_path / "c")]) == 0
    assert json.loads((tmp_path / "c" / "run.json").read_text())["scans"] == 1
    assert main(["info", cloud]) == 0
    assert "taken so" in capsys.readouterr().out
    assert main(["info", scan, "--as", "cloud"]) == 0
    assert "as requested" in capsys.readouterr().out


def test_a_ply_is_one_scan_on_request(tmp_path, sweep):
    np.save(tmp_path / "scan.npy", sweep)
    (scan,) = open_source(str(tmp_path / "scan.npy"), SourceOptions(form="scan")).records()
    assert isinstance(scan, Scan)
    assert len(scan.points) == len(sweep)


def test_a_packed_map_is_read_within_the_memory_of_its_size(tmp_path, points):
    """The limit of the child process grows with the size of the file."""
    import open3d as o3d

    path = tmp_path / "GlobalMap.pcd"
    file = str(path)
    o3d.io.write_point_cloud(
        path, o3d.geometry.PointCloud(o3d.utility.Vector3dVector(lio_map(points))), compressed=True
    )
    assert is_cloud_in_child(file)
    assert sum(len(part) for part in open_cloud(file).parts()) == len(points)


def test_one_station_of_a_scanner_on_a_tripod_is_a_cloud(tmp_path):
    """It has the order of one sweep, but sees higher and lower than a LiDAR of a robot."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 1.0)), np.radians(np.arange(-60, 80, 0.5)))
    wall = np.minimum(4.0 / np.maximum(np.cos(elevation), 1e-3), 9.0)
    flat = wall * np.cos(elevation)
    xyz = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), wall * np.sin(elevation)], axis=-1)
    assert is_cloud(pcd(tmp_path / "station.pcd", xyz.reshape(-1, 3)))
    low = np.abs(elevation.ravel()) < np.radians(45.0)
    assert not is_cloud(pcd(tmp_path / "scan.pcd", xyz.reshape(-1, 3)[low]))
