"""A function in a copy of this process: its errors arrive, and its limits hold."""

from __future__ import annotations

import os
import sqlite3
import time
from pathlib import Path

import pytest

from app.sources.opening import ProcessLimits, run_limited
from pipeline.errors import SourceError

DESCRIPTORS = Path("/proc/self/fd")
ROOMY = ProcessLimits(memory=1 << 30, cpu_s=20, wall_s=60.0)


def endless_query() -> None:
    """Computes in native code, where no signal handler of Python runs."""
    numbers = "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT count(*) FROM n"
    sqlite3.connect(":memory:").execute(numbers).fetchall()


def test_a_function_that_ends_says_nothing():
    run_limited(lambda: None, ROOMY, "x.mcap")


def test_its_error_arrives_whole():
    def refuse() -> None:
        raise SourceError("the file is empty", where="x.mcap", remedy="Copy it again.")

    with pytest.raises(SourceError) as raised:
        run_limited(refuse, ROOMY, "x.mcap")
    assert (raised.value.what, raised.value.where) == ("the file is empty", "x.mcap")
    assert raised.value.remedy == "Copy it again."


@pytest.mark.parametrize(
    ("work", "limits", "says"),
    [
        (endless_query, ProcessLimits(1 << 30, 1, 60.0), "too long"),
        (lambda: time.sleep(60), ProcessLimits(1 << 30, 20, 0.2), "too long"),
        (lambda: bytearray(400 << 20), ProcessLimits(100 << 20, 20, 60.0), "more memory"),
        (os.abort, ROOMY, "without an answer"),
        (lambda: 1 / 0, ROOMY, "without an answer"),
    ],
    ids=["computing time", "time", "memory", "abort", "unforeseen error"],
)
def test_what_exceeds_a_limit_or_ends_is_an_error_with_the_file(work, limits, says):
    begun = time.monotonic()
    with pytest.raises(SourceError, match=says) as raised:
        run_limited(work, limits, "x.mcap")
    assert "x.mcap" in str(raised.value)
    assert time.monotonic() - begun < 20.0


def test_nothing_of_the_copy_remains():
    descriptors = len(list(DESCRIPTORS.iterdir()))
    with pytest.raises(SourceError):
        run_limited(lambda: time.sleep(60), ProcessLimits(1 << 30, 20, 0.1), "x.mcap")
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)
    assert len(list(DESCRIPTORS.iterdir())) == descriptors


def test_limits_grow_with_the_file():
    small, large = ProcessLimits.for_size(10_000), ProcessLimits.for_size(4_000_000_000)
    assert small.memory < 1 << 30
    assert small.cpu_s <= 10
    assert large.memory > 8_000_000_000
    assert large.cpu_s > 200
    assert large.wall_s > 800.0
