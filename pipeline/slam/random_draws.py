"""Random numbers of a scan, which depend only on the seed of the run and the number of the scan."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.poses import Float

WORD = 2**32  # seeds below it need one 32-bit word


def draws(seed: int, index: int, particles: int) -> tuple[Float, float]:
    """Return standard normal numbers, shape (P, 3), and one uniform number in [0, 1); the same for equal
    arguments.

    Args:
        seed: Seed of the run, >= 0.
        index: Number of the scan, >= 0.
        particles: Number of particles P.
    """
    # An array of 32-bit words gives the same stream as the list and is converted faster.
    fit = 0 <= seed < WORD and 0 <= index < WORD
    rng = np.random.default_rng(np.array([seed, index], np.uint32) if fit else [seed, index])
    return rng.standard_normal((particles, 3)), float(rng.random())
