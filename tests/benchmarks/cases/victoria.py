"""Victoria Park from its raw laser scans: path error with respect to GPS, over twenty seeds."""

from __future__ import annotations

import os
from pathlib import Path

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Table

NAME = "victoria"
LINE = "Victoria Park, 100 particles, twenty seeds: path against GPS, trees, duplicates"
SEEDS = range(1, 21)


def run() -> list[Table]:
    """Twenty seeds after one pass through the stages before SLAM, and a comparison of the methods."""
    from tests.benchmarks.slam_runs import COLUMNS, by_method, mapped, seen_in, summary

    data = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
    rows, truth, parameters = seen_in(str(data / "victoria_park" / "victoria_park_ascii.zip"))
    runs = [mapped(rows, truth, parameters, seed) for seed in chosen_seeds(SEEDS)]
    note = "Rigid alignment in the plane, no shift of time; GPS itself has faults of up to 8 m."
    methods = by_method(rows, truth, parameters, "Victoria Park by `slam.method`")
    return [Table(LINE, COLUMNS, tuple(r.row() for r in runs), (summary(runs), note)), methods]
