"""A run that is sent for practice arrives as that of a robot, whole and in order; one that no live run could
choose is refused."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
from mcap.writer import Writer

from app.cli import WRONG_USAGE, main
from app.robot.practice_robot import send
from app.robot.source import LiveSource
from app.sources.opening import open_source
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers.topics import ODOMETRY, POINT_CLOUD
from pipeline.types.records import Odometry, Record, Scan
from tests.app.robot.conftest import SCANS, START_NS, Child, free_port, listening, until


def stamps(records: list[Record]) -> list[list[int]]:
    """The times of the scans and those of the odometry, each in the order of the records."""
    return [[r.stamp_ns for r in records if isinstance(r, kind)] for kind in (Scan, Odometry)]


@pytest.mark.slow
@pytest.mark.parametrize("run", ["a recording", "sim:paper?duration=1"])
def test_a_run_is_sent_as_soon_as_somebody_listens(drive: Path, run: str):
    port, scans = free_port(), SCANS if run == "a recording" else 10
    uri = str(drive) if run == "a recording" else run
    with closing(open_source(uri)) as known:
        expected = stamps(list(known.records()))
    assert len(expected[0]) == scans
    child = Child("-c", f"from app.cli import main; main({['send', uri, '--port', str(port)]})")
    try:
        assert child.hear().endswith(f"uv run stemmap zenoh:tcp/127.0.0.1:{port}")
        with closing(listening(f"zenoh:tcp/127.0.0.1:{port}")) as source:
            until(source.listen, source.waiting_for)
            records: list[Record] = []

            def come() -> bool:
                records.extend(source.take())
                return all(len(a) >= len(b) for a, b in zip(stamps(records), expected, strict=True))

            until(come, lambda: f"{[*map(len, stamps(records))]} of {[*map(len, expected)]} records")
            assert child.hear() == f"{scans} scans were sent"
            assert source.losses == {}
        assert stamps(records) == expected
    finally:
        child.kill()


def _takes(source: LiveSource) -> bool:
    return bool(source.take())


@pytest.mark.slow
def test_who_listens_later_gets_the_fixed_transforms_too():
    port = free_port()
    child = Child(
        "-c", f"from app.cli import main; main(['send', 'sim:paper?duration=12', '--port', '{port}'])"
    )
    try:
        child.hear()
        heights = []
        for _ in range(2):
            with closing(listening(f"zenoh:tcp/127.0.0.1:{port}")) as source:
                until(source.listen, source.waiting_for)
                until(partial(_takes, source), source.waiting_for)
                heights.append(source.description.T_base_lidar.t[2])
        assert heights == [0.8, 0.8]
    finally:
        child.kill()


def test_a_port_in_use_is_said(drive: Path, router: int):
    with pytest.raises(StemmapError, match=f"port {router} cannot be used"):
        send(drive, router)


@pytest.mark.parametrize("port", ["0", "65536", "any"])
def test_a_port_that_no_address_can_name_is_wrong_usage(port: str, capsys: pytest.CaptureFixture[str]):
    assert main(["send", "sim:paper?duration=1", "--port", port]) == WRONG_USAGE
    assert "a whole number from 1 to 65535" in capsys.readouterr().err


def written(path: Path, *channels: tuple[str, str, str], count: int = 1) -> Path:
    """An MCAP with messages in each channel of a topic, a type ("" without a schema) and an encoding."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "")
        for topic, msgtype, encoding in channels:
            schema = writer.register_schema(msgtype, "ros2msg", b"") if msgtype else 0
            channel = writer.register_channel(topic, encoding, schema)
            for _ in range(count):
                writer.add_message(channel, START_NS, b"\0\1\0\0", START_NS)
        writer.finish()
    return path


OTHERS = [
    ("/odom", ODOMETRY, "cdr"),
    ("/picture", "foxglove.CompressedImage", "cdr"),
    ("/bare", "", "cdr"),
    ("/ros1", POINT_CLOUD, "ros1"),
    ("/json", POINT_CLOUD, "json"),
    ("/two words", POINT_CLOUD, "cdr"),
    ("relative", POINT_CLOUD, "cdr"),
    ("/a//b", POINT_CLOUD, "cdr"),
    ("/stemmap/points", POINT_CLOUD, "cdr"),
]


@pytest.mark.parametrize("others", [*([each] for each in OTHERS), OTHERS])
def test_a_recording_without_scans_that_can_be_chosen_is_refused(
    others: list[tuple[str, str, str]], tmp_path: Path
):
    path = written(tmp_path / "run.mcap", *others)
    with pytest.raises(SourceError, match=r"no ROS 2 topic with scans .*run\.mcap.*CDR"):
        send(path, free_port())


def test_a_topic_of_scans_without_messages_is_refused(tmp_path: Path):
    path = written(tmp_path / "run.mcap", ("/points", POINT_CLOUD, "cdr"), count=0)
    with pytest.raises(SourceError, match="no ROS 2 topic with scans"):
        send(path, free_port())
