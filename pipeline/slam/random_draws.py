"""The random numbers of one scan, from the seed of the run and the number of the scan alone."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float

WORD = 2**32


def draws(seed: int, index: int, particles: int) -> tuple[Float, float]:
    """Standard normal numbers, shape (P, 3), and one that is uniform in [0, 1).

    Args:
        seed: Of the run; index: of the scan.
        particles: P.
    """
    # Words of 32 bits mean the same as the numbers, and are taken in faster.
    fit = 0 <= seed < WORD and 0 <= index < WORD
    rng = np.random.default_rng(np.array([seed, index], np.uint32) if fit else [seed, index])
    return rng.standard_normal((particles, 3)), float(rng.random())
