"""Going back: the same steps again, whatever was learnt of the gyroscope meanwhile."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

from app.worker.cursor import Cursor
from pipeline.io.readers.base import Source
from pipeline.odometry.synchroniser import steps
from tests.pipeline.odometry.test_gyro import told_by_robot


class Recording:
    """Records in the order of time, and from where they were asked for."""

    description = SimpleNamespace(uri="a recording")

    def __init__(self, records) -> None:
        self._records = records
        self.read_from: list[int | None] = []

    def records(self, start_ns=None):
        self.read_from.append(start_ns)
        return (r for r in self._records if start_ns is None or r.stamp_ns >= start_ns)


def taken(cursor):
    rest = []
    while (step := cursor.take()) is not None:
        rest.append((step.index, step.scan.stamp_ns, step.T_odom_base, step.turn, step.turn_rate))
    return rest


def test_going_back_gives_the_same_turns_without_reading_all_again():
    recording = Recording(told_by_robot(0.32, 0.3))
    cursor = Cursor(cast(Source, recording), steps)
    whole = taken(cursor)
    assert any(turn is not None for *_, turn, _ in whole)
    for index in (30, 25, 14, 37):
        cursor.go_to(index)
        assert taken(cursor) == whole[index:]
    assert all(start_ns is not None for start_ns in recording.read_from[1:])
