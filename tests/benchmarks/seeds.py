"""Seeds of a benchmark: its own, or those of `python -m tests.benchmarks --seeds`."""

from __future__ import annotations

import os

VARIABLE = "STEMMAP_BENCH_SEEDS"


def chosen_seeds(default: range) -> range:
    """Return the seeds that the environment names as FIRST-LAST, else those of the benchmark."""
    first, _, last = os.environ.get(VARIABLE, "").partition("-")
    return range(int(first), int(last or first) + 1) if first else default
