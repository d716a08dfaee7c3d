"""Going back: the same steps again, from the store or from the start of the source."""

from __future__ import annotations

from contextlib import closing

import pytest

from app.worker.cursor import Cursor, StepStore
from pipeline.io.block_file import BlockFile
from pipeline.io.checkpoints import encode
from pipeline.odometry.synchroniser import steps
from tests.pipeline.odometry.test_gyro import records_of_robot


class Recording:
    """Steps of a recording, and how often they were read from the start."""

    def __init__(self) -> None:
        self.reads = 0

    def read(self):
        self.reads += 1
        return steps(records_of_robot(0.32, 0.3))


def taken(cursor):
    rest = []
    while (step := cursor.take()) is not None:
        rest.append(encode(step))
    return rest


@pytest.mark.parametrize(("stored", "reads"), [(1000, 1), (20, 5), (0, 5)])
def test_going_back_gives_the_same_steps(stored, reads, monkeypatch):
    put = BlockFile.put_block
    monkeypatch.setattr(BlockFile, "put_block", lambda self, n, block: n < stored and put(self, n, block))
    recording = Recording()
    with closing(Cursor(recording.read, "a recording", StepStore(1 << 30))) as cursor:
        whole = taken(cursor)
        assert len(whole) > 30
        for index in (30, 25, 14, 37):
            cursor.go_to(index)
            assert taken(cursor) == whole[index:]
        assert recording.reads == reads
        assert [encode(step) for step in cursor.again(5)] == whole[5:]
        assert cursor.known == len(whole)
