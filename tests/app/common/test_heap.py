"""The heap is trimmed."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from app.common.heap import trim_heap


def resident_bytes() -> int:
    return os.sysconf("SC_PAGE_SIZE") * int(Path("/proc/self/statm").read_text().split()[1])


def test_memory_that_was_freed_below_a_living_array_returns_to_the_system():
    if not Path("/proc/self/statm").exists():
        pytest.skip("the system has no /proc")
    blocks = [np.ones(6_000) for _ in range(2_000)]  # 48 kB each, small enough for the heap
    last = blocks[-1]
    blocks.clear()
    before = resident_bytes()
    if not trim_heap():
        pytest.skip("the C library has no malloc_trim")
    assert before - resident_bytes() > 50 * 10**6
    assert last.sum() == 6_000
