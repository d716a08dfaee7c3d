"""Stored frames come back with the path of their time, and take little memory however often it changes."""

from __future__ import annotations

import tracemalloc
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.worker.remap import FrameStore
from pipeline.ground.terrain_map import no_height_map
from pipeline.io.block_file import BlockFile
from tests.app import fakes


def put(store: FrameStore, xs: list[float]) -> None:
    index = len(xs) - 1
    store.put(fakes.frame(index, fakes.START_NS + index), fakes.path(xs), 0.1 * index, np.zeros(0))


def xs_of(store: FrameStore, index: int) -> list[float] | None:
    shown = store.read(index)
    return None if shown is None else shown.path.x.tolist()


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 30)), min_size=1, max_size=30))
def test_each_scan_has_the_path_of_its_time(moves: list[tuple[bool, int]]) -> None:
    """A scan with True replaces the path from a row onwards; False goes back to that scan."""
    xs: list[float] = []
    known: list[list[float]] = []
    with closing(FrameStore(1 << 30)) as store:
        for number, (is_correction, row) in enumerate(moves):
            if is_correction:
                xs = [x if k < row else x + 1.0 for k, x in enumerate(xs)]
            elif row < len(known):
                store.forget_from(row)
                del known[row:]
                xs = list(known[-1]) if known else []
            xs = [*xs, 0.5 * number]
            put(store, xs)
            known.append(xs)
            assert [xs_of(store, k) for k in range(len(known))] == known


@pytest.mark.slow
def test_corrections_of_a_long_path_take_no_memory() -> None:
    with closing(FrameStore(1 << 30)) as store:
        xs = np.zeros(20_000).tolist()
        store._scans = len(xs) - 60
        store._path = fakes.path(xs[:-60])
        tracemalloc.start()
        before = tracemalloc.get_traced_memory()[0]
        for k in range(60, 0, -1):
            put(store, (np.arange(len(xs) - k + 1) + float(k)).tolist())
        grown = tracemalloc.get_traced_memory()[0] - before
        tracemalloc.stop()
    assert grown < 3_000_000, "one path of 20,000 rows takes 0.8 MB"


def test_what_the_file_refuses_ends_the_store_and_harms_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    put_block = BlockFile.put_block
    monkeypatch.setattr(BlockFile, "put_block", lambda self, n, block: n < 5 and put_block(self, n, block))
    with closing(FrameStore(1 << 30)) as store:
        known: list[list[float]] = []
        for k in range(8):
            known.append([float(k >= 5) + 0.1 * row for row in range(k + 1)])
            put(store, known[-1])
        assert [xs_of(store, k) for k in range(8)] == [*known[:5], None, None, None]
        store.forget_from(3)
        put(store, known[3])
        assert xs_of(store, 3) == known[3]


def test_after_a_scan_that_is_too_large_the_others_have_their_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    ground = no_height_map()
    with closing(FrameStore(1 << 30)) as store:
        for index in range(3):
            frame = replace(fakes.frame(index, fakes.START_NS + index), ground=ground)
            with monkeypatch.context() as limited:
                if index == 0:
                    limited.setattr("app.worker.protocol.LARGEST_MESSAGE", 100)
                store.put(frame, fakes.path([0.0] * (index + 1)), 0.1 * index, np.zeros(0))
        assert store.read(0) is None
        for index in (1, 2):
            shown = store.read(index)
            assert shown is not None
            assert shown.frame.ground is not None


def test_the_last_scans_stay_when_the_file_is_full() -> None:
    """Also while the ground does not change for long: it is stored again before its first scan is dropped."""
    ground = no_height_map()
    scans, most = 400, 300_000
    with closing(FrameStore(most)) as store:
        for index in range(scans):
            frame = replace(fakes.frame(index, fakes.START_NS + index), ground=ground)
            store.put(frame, fakes.path([0.0] * (index + 1)), 0.1 * index, np.zeros(0))
        assert store.nbytes <= most
        assert store.read(0) is None
        for back in range(1, 21):
            shown = store.read(scans - back)
            assert shown is not None
            assert shown.frame.ground is not None
            assert shown.path.x.shape == (scans - back + 1,)
