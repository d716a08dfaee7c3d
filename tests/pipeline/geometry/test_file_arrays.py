"""Arrays that grow with a drive are in files and take no memory of the process."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.geometry.columns import GrowingColumns
from pipeline.geometry.file_arrays import LEAST, extended
from pipeline.seen_area import SeenRecorder
from tests.benchmarks.machine import anonymous_mib

ROWS = 1_000_000
on_linux = pytest.mark.skipif(
    sys.platform != "linux", reason="only Linux tells the memory that is in no file"
)


@on_linux
def test_long_columns_take_no_memory_of_the_process() -> None:
    columns, before = GrowingColumns(np.zeros(0, np.int64), np.zeros((0, 3))), anonymous_mib()
    for start in range(0, ROWS, 1000):
        rows = np.arange(start, start + 1000)
        columns.write(start, rows, np.column_stack([rows, rows, rows]))
    assert anonymous_mib() - before < 4  # of 32 MB
    assert np.array_equal(columns.column(0), np.arange(ROWS))
    assert np.array_equal(columns.column(1)[:, 2], np.arange(ROWS))


@on_linux
def test_the_views_of_a_drive_take_no_memory_of_the_process() -> None:
    recorder, before, view = SeenRecorder(), anonymous_mib(), np.full((2, 360), 4.0)
    for stamp in range(10_000):
        recorder.add(stamp, view)
    assert anonymous_mib() - before < 5  # of 29 MB


def open_files() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


@on_linux
def test_their_files_are_deleted_with_them() -> None:
    known = open_files()
    array = extended(np.zeros(0, np.int64), LEAST)
    assert open_files() == known + 1
    del array
    assert open_files() == known


def test_they_are_in_memory_on_a_full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    array = extended(np.zeros((0, 2)), LEAST)
    array[:] = 1.0
    assert array.base is None
    assert array.sum() == 2 * LEAST


def test_they_leave_room_on_the_disk_for_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.geometry.file_arrays.SPARE_BYTES", 1 << 62)
    assert extended(np.zeros(0), LEAST).base is None


def test_they_begin_with_the_given_rows() -> None:
    rows = np.arange(6 * LEAST).reshape(-1, 3)[::2]
    array = extended(rows, 2 * LEAST)
    assert array.base is not None
    assert np.array_equal(array[: len(rows)], rows)
    array[:] = 1
    assert rows[1, 0] == 6


def test_another_thread_sees_no_row_before_it_is_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    table, seen = GrowingColumns(np.arange(4), np.arange(4)), list[list[int]]()

    def looked_at(rows: Any, length: int) -> Any:
        seen.append(table.column(0).tolist())
        return extended(rows, length)

    monkeypatch.setattr("pipeline.geometry.columns.extended", looked_at)
    table.write(4, np.array([4]), np.array([4]))
    assert seen == 2 * [[0, 1, 2, 3]]
    assert table.column(0).tolist() == [0, 1, 2, 3, 4]
