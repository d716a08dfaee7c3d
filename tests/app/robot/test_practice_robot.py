"""A run that is sent for practice arrives as that of a robot, whole and in order."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from app.robot.practice_robot import send
from pipeline.errors import StemmapError
from pipeline.types.records import Odometry, Record, Scan
from tests.app.robot.conftest import SCANS, Child, free_port, listening, until


@pytest.mark.parametrize("run", ["a recording", "sim:paper?duration=1"])
def test_a_run_is_sent_as_soon_as_somebody_listens(drive: Path, run: str):
    port, scans = free_port(), SCANS if run == "a recording" else 10
    words = ["send", str(drive) if run == "a recording" else run, "--port", str(port)]
    child = Child("-c", f"from app.cli import main; main({words})")
    assert child.hear().endswith(f"uv run stemmap zenoh:tcp/127.0.0.1:{port}")
    with closing(listening(f"zenoh:tcp/127.0.0.1:{port}")) as source:
        until(source.listen, source.waiting_for)
        records: list[Record] = []

        def come() -> bool:
            records.extend(source.take())
            return sum(isinstance(record, Scan) for record in records) >= scans - 1

        until(come, lambda: f"{len(records)} records")
        assert child.hear() == f"{scans} scans were sent"
        assert source.losses == {}
        assert any(isinstance(record, Odometry) for record in records)
    child.kill()


def test_a_port_in_use_is_said(drive: Path, router: int):
    with pytest.raises(StemmapError, match=f"port {router} cannot be used"):
        send(drive, router)
