"""One drive of a VLP-16 as a capture of packets and as recordings: the same map, whatever the container."""

from __future__ import annotations

import csv
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from app.batch.map_run import OfflineRun, map_run
from app.sources.opening import open_source
from pipeline.config import preset
from pipeline.simulation.run import SimulatedRun
from pipeline.types.records import Float
from tests.pipeline.io.recordings import POINT, START_NS, Author, Write, write_recording
from tests.pipeline.io.velodyne_drive import (
    SCAN_TYPE,
    open_drive,
    packets_of,
    write_capture,
    write_messages,
)

SWEEPS, SIGMA = 20, 0.013
KINDS = ("bag", "db3", "mcap")
SAME_DBH = 0.2  # cm
# After two seconds, few stems are seen from enough sides for the default.
PARAMETERS = preset("forest").replace({"tracking.dbh_arc_min": 60.0})
MAP_FILES = ("trees.csv", "trees.geojson", "path.csv", "detections.csv", "terrain.csv", "seen.csv")


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The folder of the map by container and form of the scans."""
    folder = tmp_path_factory.mktemp("same")
    run = open_drive("sim:stand?duration=4", SIGMA)
    single, dual = ([packets_of(run, k, dual=both) for k in range(SWEEPS)] for both in (False, True))
    write_capture(folder / "single.pcap", single)
    write_capture(folder / "dual.pcap", dual)
    drives = {"pcap": folder / "single.pcap", "dual pcap": folder / "dual.pcap"}
    drives["packets"] = recorded(folder / "packets", "mcap", lambda a, w: packets(a, w, single))
    for kind in KINDS:
        drives[kind] = recorded(folder / kind, kind, lambda a, w: clouds(a, w, run))
    found = {}
    for name, path in drives.items():
        found[name] = folder / f"map of {name}"
        with closing(open_source(str(path))) as source:
            map_run(OfflineRun(source, "forest", PARAMETERS, 0, "auto"), found[name])
    return found


def recorded(folder: Path, kind: str, fill: Callable[[Author, Write], None]) -> Path:
    folder.mkdir()
    return write_recording(kind, folder, fill)


def packets(author: Author, write: Write, sweeps: list[list[tuple[int, bytes]]]) -> None:
    time = "time" if author.kind == "bag" else "builtin_interfaces/Time"
    packet = get_types_from_msg(f"{time} stamp\nuint8[1206] data", "velodyne_msgs/msg/VelodynePacket")
    scan = "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets"
    author.store.register({**packet, **{SCAN_TYPE: get_types_from_msg(scan, SCAN_TYPE)[SCAN_TYPE]}})
    write_messages(author, write, sweeps)


def clouds(author: Author, write: Write, run: SimulatedRun) -> None:
    """The scans as the driver publishes them: stamped with the end of the sweep, with the times of the points
    before it."""
    for sweep in range(SWEEPS):
        scan, period_ns = run.sweep(sweep).scan, run.lidar.period_ns
        assert scan.ring is not None
        assert scan.offset_ns is not None
        table = np.zeros(len(scan.points), POINT)
        for k, axis in enumerate("xyz"):
            table[axis] = scan.points[:, k]
        table["ring"], table["intensity"] = scan.ring, scan.reflectance
        table["time"] = (scan.offset_ns - period_ns) * 1e-9
        end_ns = (START_NS + (sweep + 1) * period_ns) // 1000 * 1000
        write("/velodyne_points", "sensor_msgs/msg/PointCloud2", end_ns, author.cloud(end_ns, table))


def trees(folder: Path) -> Float:
    """x, y [m] and diameter [cm] of the trees of a map, sorted, shape (T, 3)."""
    with (folder / "trees.csv").open(newline="") as file:
        rows = [
            [float(row[name] or "nan") for name in ("x_m", "y_m", "dbh_cm")] for row in csv.DictReader(file)
        ]
    return np.array(sorted(rows))


@pytest.mark.slow
@pytest.mark.parametrize(("one", "other"), [("bag", "db3"), ("bag", "mcap"), ("pcap", "packets")])
def test_the_files_of_a_map_have_the_same_bytes_from_each_container(
    one: str, other: str, maps: dict[str, Path]
):
    for name in MAP_FILES:
        assert (maps[one] / name).read_bytes() == (maps[other] / name).read_bytes(), name


@pytest.mark.slow
@pytest.mark.parametrize("capture", ["pcap", "dual pcap"])
def test_a_capture_gives_the_trees_of_the_clouds_of_the_driver(capture: str, maps: dict[str, Path]):
    """Packets round ranges to 2 mm, and lasers fire microseconds apart."""
    ours, theirs = trees(maps[capture]), trees(maps["db3"])
    assert len(theirs) > 5
    np.testing.assert_allclose(ours[:, :2], theirs[:, :2], atol=0.02)
    known = np.isfinite(theirs[:, 2]) & (np.hypot(theirs[:, 0], theirs[:, 1]) < 10.0)
    assert known.sum() > 5
    np.testing.assert_allclose(ours[known, 2], theirs[known, 2], atol=SAME_DBH)
