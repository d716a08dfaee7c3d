"""Random numbers of a scan: determined by the seed and the number of the scan."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pipeline.slam.random_draws import draws


@given(st.integers(0, 2**70), st.integers(0, 2**40))
def test_seed_and_scan_decide(seed: int, index: int) -> None:
    noise, offset = draws(seed, index, 20)
    again, same = draws(seed, index, 20)
    rng = np.random.default_rng([seed, index])  # numbers of any size are taken alike
    assert noise.tobytes() == again.tobytes() == rng.standard_normal((20, 3)).tobytes()
    assert offset == same == rng.random()
    others = [draws(seed + 1, index, 20), draws(seed, index + 1, 20)]
    assert all(not np.any(np.isin(noise, other)) and offset != at for other, at in others)
