"""Stems of the forests of Wild-Places, with simulated odometry of large drift."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from tests.benchmarks.cases.oxford import COLUMNS, mapped_folder
from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

NAME = "wild_places"
LINE = "Wild-Places, stems of another forest with odometry that drifts by 70 to 190 m: error of the path"
SEEDS = range(1, 4)


def run() -> list[Table]:
    """A table with each recording of the folder and each seed; the odometry differs by seed as well."""
    from tests.benchmarks.tree_manager_folder import read_recorded, write_states

    root = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
    rows = list[tuple[Cell, ...]]()
    for file in sorted((root / "wild_places").glob("*.npz")):
        recorded = read_recorded(file)
        with tempfile.TemporaryDirectory(prefix="stemmap-wild-places-") as folder:
            write_states(recorded, Path(folder), 1)
            for seed in chosen_seeds(SEEDS):
                rows.append((file.stem, *mapped_folder(recorded, Path(folder), seed)))
                print(f"{file.stem}, seed {seed}: {rows[-1][3]:.3f} m", file=sys.stderr, flush=True)
    return [Table("Paths of Wild-Places", ("recording", *COLUMNS), tuple(rows))]
