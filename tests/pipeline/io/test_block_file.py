"""Blocks in a file that two indices share."""

from __future__ import annotations

import tracemalloc
from contextlib import closing

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.io.block_file import BlockFile


@given(
    st.lists(st.tuples(st.sampled_from(["put", "forget", "copy", "close"]), st.integers(0, 9)), max_size=40)
)
def test_copies_never_see_what_another_one_stores_or_forgets(moves: list[tuple[str, int]]) -> None:
    rng = np.random.default_rng(0)
    files, expected = [BlockFile()], [dict[int, bytes]()]
    for name, number in moves:
        k = number % len(files)
        if name == "put" and number not in expected[k]:
            content = rng.bytes(number + 1)
            assert files[k].put_block(number, content)
            expected[k][number] = content
        elif name == "forget":
            files[k].forget_from(number)
            expected[k] = {n: content for n, content in expected[k].items() if n < number}
        elif name == "copy":
            files.append(files[k].copy())
            expected.append(dict(expected[k]))
        elif name == "close" and len(files) > 1:
            files.pop(k).close()
            expected.pop(k)
        for file, blocks in zip(files, expected, strict=True):
            assert {n: file.read_block(n, bytes) for n in range(10) if n in file} == blocks
    for file in files:
        file.close()


def test_the_space_of_forgotten_blocks_is_used_again_once_the_file_is_not_shared() -> None:
    with closing(BlockFile()) as file:
        content = np.random.default_rng(0).bytes(1000)
        file.put_block(0, content)
        file.put_block(1, content)
        size, other = file.nbytes, file.copy()
        file.forget_from(1)
        assert file.nbytes == size
        other.close()
        file.forget_from(1)
        assert file.nbytes == size // 2


def test_dropped_blocks_take_no_memory() -> None:
    with closing(BlockFile(4000, drops_oldest=True)) as file:
        for number in range(2000):
            assert file.put_block(number, bytes(10))
        tracemalloc.start()
        try:
            for number in range(2000, 12_000):
                assert file.put_block(number, bytes(10))
            grown = tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()
    assert grown < 60_000  # of the 200 blocks of the file


@given(
    st.lists(
        st.tuples(st.sampled_from(["put", "put", "put", "forget", "copy"]), st.integers(0, 11)), max_size=60
    )
)
def test_a_full_file_drops_the_blocks_that_were_stored_first(moves: list[tuple[str, int]]) -> None:
    """What is read is what was stored, also while a copy lives; what is dropped was stored before all that
    stays; and the newest quarter of the file always stays."""
    most, rng = 4000, np.random.default_rng(0)
    with closing(BlockFile(most, drops_oldest=True)) as file:
        stored: dict[int, bytes] = {}  # in the order in which they were stored
        copies = list[BlockFile]()
        for name, number in moves:
            if name == "put" and number not in file:
                stored.pop(number, None)
                stored[number] = rng.bytes(50 + 100 * number)
                assert file.put_block(number, stored[number])
            elif name == "forget":
                file.forget_from(number)
                stored = {n: content for n, content in stored.items() if n < number}
            elif name == "copy":
                copies.append(file.copy())
            kept = [n in file for n in stored]
            assert kept == sorted(kept), "the oldest ones are dropped first"
            assert len(file) == sum(kept)
            assert file.nbytes <= most
            for n, content in stored.items():
                assert file.read_block(n, bytes) == (content if n in file else None)
            newest = list(stored.values())[::-1]
            used = np.cumsum([len(content) + 20 for content in newest])
            assert all(n in file for n, size in zip(list(stored)[::-1], used, strict=True) if size < most / 4)
        assert not file.refusal
        for each in copies:
            each.close()


def test_a_block_larger_than_the_file_is_refused_and_drops_nothing() -> None:
    with closing(BlockFile(1000, drops_oldest=True)) as file:
        rng = np.random.default_rng(0)
        assert file.put_block(0, rng.bytes(500))
        assert not file.put_block(1, rng.bytes(2000))
        assert 0 in file
        assert "limit" in file.refusal
