"""Going back: the same steps again, whatever was learnt of the gyroscope meanwhile."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

from app.worker.cursor import Cursor
from pipeline.io.readers.base import Source
from pipeline.types.records import Scan
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
    cursor = Cursor(cast(Source, recording))
    whole = taken(cursor)
    assert any(turn is not None for *_, turn, _ in whole)
    for index in (30, 25, 14, 37):
        cursor.go_to(index)
        assert taken(cursor) == whole[index:]
    assert all(start_ns is not None for start_ns in recording.read_from[1:])


class Forgetful(Recording):
    """A recording that gives other motion when it is not read from the start."""

    def records(self, start_ns=None):
        kept = list(super().records(start_ns))
        return iter(kept if start_ns is None else [r for r in kept if isinstance(r, Scan)])


def test_where_reading_from_the_middle_gives_other_steps_all_is_read_again():
    recording = Forgetful(told_by_robot(0.32, 0.3))
    cursor = Cursor(cast(Source, recording))
    whole = taken(cursor)
    for index in (30, 14):
        cursor.go_to(index)
        assert taken(cursor) == whole[index:]
    assert recording.read_from.count(None) == 3
