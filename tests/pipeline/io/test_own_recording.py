"""A simulated run written as MCAP is read back unchanged."""

from __future__ import annotations

import struct
from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.records import Attachment
from mcap.writer import CompressionType, Writer

from pipeline.errors import SourceError
from pipeline.io.ground_truth import ATTACHMENT, read_truth
from pipeline.io.readers import Source, open_source
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.recording.mcap_writer import repair, write_recording
from pipeline.types.records import Imu, Odometry, Scan
from tests.pipeline.io.conftest import Opened

URI = "sim:stand?duration=2&seed=3"


def write(path: Path, simulated: Source) -> None:
    """Record a source."""
    known = simulated.description
    write_recording(
        path,
        simulated.records(),
        sensor=known.sensor,
        T_base_lidar=known.T_base_lidar,
        truth=simulated.truth(),
    )


def test_a_simulated_run_comes_back_from_its_recording(tmp_path: Path, opened: Opened):
    simulated = open_source(URI)
    path = tmp_path / "run.mcap"
    write(path, simulated)
    recorded = opened(path)
    known, other = recorded.description, simulated.description
    assert known.sensor == other.sensor
    assert (known.has_odometry, known.has_imu) == (other.has_odometry, other.has_imu)
    assert (known.scans, known.start_ns, known.end_ns) == (other.scans, other.start_ns, other.end_ns)
    np.testing.assert_allclose(known.T_base_lidar.t, other.T_base_lidar.t, atol=1e-12)
    np.testing.assert_allclose(known.T_base_lidar.R, other.T_base_lidar.R, atol=1e-12)
    assert known.warnings == ()
    for kind in (Scan, Odometry, Imu):
        ours = [record for record in recorded.records() if isinstance(record, kind)]
        theirs = [record for record in simulated.records() if isinstance(record, kind)]
        assert [record.stamp_ns for record in ours] == [record.stamp_ns for record in theirs]
        for a, b in zip(ours, theirs, strict=True):
            if isinstance(a, Scan) and isinstance(b, Scan):
                np.testing.assert_array_equal(a.points, b.points)
                np.testing.assert_array_equal(a.ring, b.ring)
            if isinstance(a, Odometry) and isinstance(b, Odometry):
                np.testing.assert_allclose(a.T_odom_base.t, b.T_odom_base.t, atol=1e-12)
                np.testing.assert_allclose(a.T_odom_base.R, b.T_odom_base.R, atol=1e-9)
            if isinstance(a, Imu) and isinstance(b, Imu):
                np.testing.assert_allclose(a.angular_velocity, b.angular_velocity, atol=1e-12)
    assert recorded.losses == {}


def test_the_truth_comes_back_from_the_recording(tmp_path: Path, opened: Opened):
    simulated = open_source(URI)
    path = tmp_path / "run.mcap"
    write(path, simulated)
    ours, theirs = opened(path).truth(), simulated.truth()
    assert ours is not None
    assert theirs is not None
    assert ours.trees is not None
    assert theirs.trees is not None
    assert ours.path is not None
    assert theirs.path is not None
    for name in ("x", "y", "dbh"):
        np.testing.assert_array_equal(getattr(ours.trees, name), getattr(theirs.trees, name))
    assert ours.trees.kind == theirs.trees.kind
    for name in ("stamp_ns", "x", "y", "yaw"):
        np.testing.assert_array_equal(getattr(ours.path, name), getattr(theirs.path, name))
    assert ours.path.same_frame


def test_an_attachment_is_read_with_its_size_and_checksum(tmp_path: Path):
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2", "")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        writer.register_channel("/chatter", "cdr", schema)
        writer.add_attachment(0, 0, ATTACHMENT, "application/json", b"0123456789")
        writer.finish()
    with closing(McapFile(path)) as container:
        assert container.attachment(ATTACHMENT, 10) == b"0123456789"
        assert container.attachment("other", 10) is None
        with pytest.raises(SourceError, match="longer than"):
            container.attachment(ATTACHMENT, 9)
    path.write_bytes(path.read_bytes().replace(b"0123456789", b"0123456780"))
    with closing(McapFile(path)) as container, pytest.raises(SourceError, match="checksum"):
        container.attachment(ATTACHMENT, 10)
    with closing(McapFile(path)) as container:
        assert not any(isinstance(record, Attachment) for record in container.whole_records())
        assert container.damage == {"damaged attachments": 1}


def test_a_recording_that_ends_after_a_whole_record_has_lost_nothing(tmp_path: Path):
    path = tmp_path / "run.mcap"
    write(path, open_source(URI))
    content = path.read_bytes()
    (summary,) = struct.unpack_from("<Q", content, len(content) - 8 - 20)
    data_end = summary - 9 - 4
    assert content[data_end] == Opcode.DATA_END
    for length, losses in (
        (data_end, {}),
        (data_end - 1, None),
        (data_end + 5, {"bytes at the end of a recording that was cut": 5}),
    ):
        path.write_bytes(content[:length])
        mended = repair(path, tmp_path / "mended.mcap")
        if losses is None:
            assert sum(mended.losses.values()) > 1
        else:
            assert mended.losses == losses
        with closing(McapFile(path)) as container:
            assert container.damage


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"version": 2}, "version"),
        ({"trees": {"x": [1.0], "y": [], "dbh": [None], "kind": ["tree"]}}, "differ in length"),
        ({"trees": {"x": [1.0], "y": [1.0], "dbh": [None], "kind": ["dragon"]}}, "dragon"),
        ({"trees": {"x": ["1"], "y": [1.0], "dbh": [None], "kind": ["tree"]}}, "float"),
        ({"trees": {"x": [1e200], "y": [1.0], "dbh": [None], "kind": ["tree"]}}, "1e8|100000000"),
        ({"path": {"stamp_ns": [-1], "x": [0.0], "y": [0.0], "yaw": [0.0]}}, "stamp_ns"),
        ({"sensor": {"azimuth_step": 0.0}}, "azimuth_step"),
    ],
)
def test_a_truth_of_another_form_is_refused(changes: dict[str, object], reason: str):
    read_truth(msgspec.json.encode({"version": 1}), "here")
    with pytest.raises(SourceError, match=reason):
        read_truth(msgspec.json.encode({"version": 1, **changes}), "here")


def test_a_damaged_truth_does_not_refuse_the_recording(tmp_path: Path, opened: Opened):
    path = tmp_path / "run.mcap"
    write(path, open_source(URI))
    content = path.read_bytes()
    assert content.count(b'"azimuth_step"') == 1
    path.write_bytes(content.replace(b'"azimuth_step"', b'"azimuth_stop"'))
    source = opened(path)
    assert source.truth() is None
    assert source.description.warnings == (
        f"the attached ground truth is not used: the attachment {ATTACHMENT} has a wrong checksum",
    )
    assert sum(isinstance(record, Scan) for record in source.records()) == source.description.scans


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b'{"version": 1e999}'])
def test_a_truth_that_is_no_json_is_refused(content: bytes):
    with pytest.raises(SourceError, match="ground truth cannot be read"):
        read_truth(content, "here")
