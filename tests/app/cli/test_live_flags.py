"""What --record and --publish may be asked of."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import pytest

from app.cli import WRONG_USAGE, main
from app.cli.flags import recording_place
from pipeline.errors import ParameterError

ROBOT, SENSOR = "zenoh:tcp/127.0.0.1:7447", "velodyne:127.0.0.1:2368"


def asked(record: str | None = None, *, publish: bool = False) -> Namespace:
    return Namespace(record=record, publish=publish)


def test_robots_are_recorded_to_the_file_that_was_named(tmp_path: Path):
    assert recording_place(asked(), "sim:stand", "run.mcap") == ""
    place = tmp_path / "live.mcap"
    assert recording_place(asked(str(place), publish=True), ROBOT, f"{ROBOT}?robot=red") == str(place)
    assert recording_place(asked(str(place)), SENSOR) == str(place)


@pytest.mark.parametrize(
    ("flags", "sources", "reason"),
    [
        (asked("x"), ("sim:stand",), "live robot"),
        (asked("x"), (ROBOT, "run.mcap"), "live robot"),
        (asked(publish=True), (SENSOR,), "only over Zenoh"),
        (asked(publish=True), ("velodyne:127.0.0.1:2368",), "only over Zenoh"),
    ],
)
def test_what_cannot_be_recorded_or_published_is_refused(
    flags: Namespace, sources: tuple[str, ...], reason: str
):
    with pytest.raises(ParameterError, match=reason):
        recording_place(flags, *sources)


def test_the_command_line_says_so(capsys: pytest.CaptureFixture[str]):
    assert main(["serve", "sim:stand", "sim:paper", "--record", "--no-browser"]) == WRONG_USAGE
    assert "live robot" in capsys.readouterr().err
