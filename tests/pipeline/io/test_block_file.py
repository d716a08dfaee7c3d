"""Blocks in a file that two indices share."""

from __future__ import annotations

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
