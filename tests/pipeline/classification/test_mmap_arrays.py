"""Arrays on pages of their own are arrays like others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipeline.classification.voxel_map import SMALL, copied, zeros
from tests.benchmarks.machine import resident_mib


@pytest.mark.parametrize("shape", [0, 5, (0, 3), (7, 3), SMALL, (SMALL, 3)])
@pytest.mark.parametrize("dtype", [np.float32, np.int64])
def test_they_are_zeros_that_can_be_written_and_copied(shape, dtype):
    array = zeros(shape, dtype)
    assert array.dtype == dtype
    assert array.shape == (shape if isinstance(shape, tuple) else (shape,))
    assert not array.any()
    array += 1
    copy = copied(array)
    array += 1
    assert (copy == 1).all()


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell")
def test_untouched_pages_take_no_memory_and_dropped_ones_are_given_back():
    before = resident_mib()
    array = zeros(1 << 25, np.float64)  # 256 MiB
    assert resident_mib() < before + 64
    array[: 1 << 24] = 1.0
    assert resident_mib() > before + 100
    del array
    assert resident_mib() < before + 64
