"""What goes wrong in the field: a clock that is set, a LiDAR that is unplugged, a disk that is full."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.worker.protocol import Begin, Open
from pipeline.config import Parameters
from pipeline.io.readers import open_source
from pipeline.io.readers.topics import IMU, ODOMETRY, POINT_CLOUD
from pipeline.io.recording.mcap_writer import repair
from tests.app.robot.conftest import SCANS, Child, until
from tests.app.robot.test_live_session import URI, announce, stage
from tests.app.robot.test_live_session import sending as sending
from tests.app.robot.test_recording import Heard, Played, map_files
from tests.app.robot.test_recording import stand as stand

_STAMPED = (POINT_CLOUD, ODOMETRY, IMU)  # their header comes first


class SetClock(Heard):
    """As Heard, of a robot whose clock is set in the middle of the run."""

    def __init__(self, run: Path, step_s: int | None) -> None:
        super().__init__(run, None)
        half = len(self._messages) // 2
        for k, message in enumerate(self._messages):
            if k >= half and self._kinds[message.channel].msgtype in _STAMPED:
                self._messages[k] = replace(message, payload=restamped(message.payload, step_s))


def restamped(payload: bytes, step_s: int | None) -> bytes:
    """The message with its header's stamp set by so many seconds, or to 1970."""
    (seconds,) = struct.unpack_from("<i", payload, 4)
    changed = 1000 if step_s is None else seconds + step_s
    return payload[:4] + struct.pack("<i", changed) + payload[8:]


def trees(files: dict[str, bytes]) -> Any:
    rows = files["trees.csv"].decode().splitlines()[1:]
    return np.array([[float(value) for value in row.split(",")[1:3]] for row in rows])


@pytest.fixture(scope="module")
def usual(stand: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The trees of the run with a clock that nobody set."""
    return trees(map_files(Played(SetClock(stand, 0)), tmp_path_factory.mktemp("usual") / "out"))


@pytest.mark.slow
@pytest.mark.parametrize("step_s", [3600, -3600, None], ids=["+1 h", "-1 h", "1970"])
def test_a_clock_that_is_set_changes_no_map(stand: Path, usual: Any, tmp_path: Path, step_s: int | None):
    found = trees(map_files(Played(SetClock(stand, step_s)), tmp_path / "out"))
    assert len(found) == len(usual) > 5
    np.testing.assert_allclose(found, usual, atol=0.02)
    told = json.loads((tmp_path / "out" / "run.json").read_text(encoding="utf-8"))["warnings"]
    assert any("clock was set by" in str(warning) for warning in told)


def test_a_lidar_that_is_unplugged_and_comes_back_goes_on_in_the_same_map(sending: Any):
    with stage() as on:
        on.commands.put(Open(URI))
        until(lambda: on.links)
        link = on.links[0]
        announce(link, sending)
        until(lambda: link.channels)
        sending(link, 0, 11)
        until(on.opened)
        on.commands.put(Begin(1, Parameters().model_dump(), 3, True))
        until(lambda: on.shown and on.shown[-1] == 10)
        link.silence_s = 4.0  # its node is still announced: only its cable is out
        until(lambda: on.status.state == "waiting")
        assert "is announced and silent" in on.status.detail
        sending(link, 11, SCANS)
        until(lambda: on.shown[-1] == SCANS - 1)
        until(lambda: on.status.state == "playing")
        assert len(on.opened()) == 1, "the run is the same"
        assert on.shown == sorted(set(on.shown))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits of file sizes")
def test_a_file_that_may_not_grow_ends_the_recording_alone(drive: Path, tmp_path: Path):
    out = tmp_path / "live.mcap"
    child = Child("-m", "tests.app.robot.full_disk", str(drive), str(out), "1500000")
    told = json.loads(child.hear())
    child.kill()
    assert told["shown"] == SCANS, "every scan was mapped"
    assert "File too large" in told["recording"]
    assert 0 < out.stat().st_size <= 1_500_000
    repair(out, tmp_path / "mended.mcap")
    with closing(open_source(str(tmp_path / "mended.mcap"))) as mended:
        records: Iterator[Any] = mended.records()
        assert next(records) is not None
