"""One drive of a VLP-16 as a capture and as recordings of ROS: the same scans, the same sensor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg

from pipeline.io.readers.base import Source
from pipeline.types.records import Scan
from tests.pipeline.io.conftest import Opened
from tests.pipeline.io.recordings import Author, Write, write_recording
from tests.pipeline.io.velodyne_drive import (
    SCAN_TYPE,
    open_drive,
    packets_of,
    write_capture,
    write_messages,
)

SIGMA = 0.013


@pytest.fixture(scope="module", params=[False, True], ids=["single", "dual"])
def files(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The path of the drive by its container."""
    folder = tmp_path_factory.mktemp("drive")
    run = open_drive("sim:stand?duration=2", SIGMA)
    sweeps = [packets_of(run, k, dual=request.param) for k in range(4)]
    write_capture(folder / "drive.pcap", sweeps)

    def fill(author: Author, write: Write) -> None:
        time = "time" if author.kind == "bag" else "builtin_interfaces/Time"
        packet = get_types_from_msg(f"{time} stamp\nuint8[1206] data", "velodyne_msgs/msg/VelodynePacket")
        scan = "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets"
        author.store.register({**packet, **{SCAN_TYPE: get_types_from_msg(scan, SCAN_TYPE)[SCAN_TYPE]}})
        write_messages(author, write, sweeps)

    found = {"pcap": folder / "drive.pcap"}
    for kind in ("bag", "db3", "mcap"):
        (folder / kind).mkdir()
        found[kind] = write_recording(kind, folder / kind, fill)
    return found


def scans(source: Source) -> list[Scan]:
    return [record for record in source.records() if isinstance(record, Scan)]


@pytest.mark.parametrize("kind", ["pcap", "bag", "db3", "mcap"])
def test_the_range_noise_is_measured(kind: str, files: dict[str, Path], opened: Opened):
    sensor = opened(files[kind]).description.sensor
    assert sensor.name == "VLP-16"
    assert sensor.range_sigma == pytest.approx(SIGMA, rel=0.15)


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_all_containers_give_the_same_scans(kind: str, files: dict[str, Path], opened: Opened):
    capture, other = opened(files["pcap"]), opened(files[kind])
    assert capture.description.sensor == other.description.sensor
    ours, theirs = scans(capture), scans(other)
    assert len(ours) == len(theirs) == 4
    for a, b in zip(ours, theirs, strict=True):
        assert a.stamp_ns == b.stamp_ns
        for name in ("points", "reflectance", "ring", "offset_ns"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_equal_echoes_of_a_beam_are_one_point(files: dict[str, Path], opened: Opened):
    for scan in scans(opened(files["pcap"])):
        assert scan.ring is not None
        rows = np.column_stack([scan.points, scan.ring])
        assert len(np.unique(rows, axis=0)) == len(rows)
        assert 10_000 < len(rows) < 28_800
