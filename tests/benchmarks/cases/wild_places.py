"""Stems of the forests of Wild-Places, with simulated odometry of large drift."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

from tests.benchmarks.cases.oxford import COLUMNS, mapped_folder
from tests.benchmarks.process import on_cores
from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

NAME = "wild_places"
LINE = "Wild-Places, stems of another forest with odometry that drifts by 70 to 190 m: error of the path"
SEEDS = range(1, 4)


def run() -> list[Table]:
    """A table with each recording of the folder and each seed; each seed has another odometry."""
    root = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
    files = sorted((root / "wild_places").glob("*.npz"))
    rows = list[tuple[Cell, ...]]()
    for (file, seed), row in on_cores(
        _mapped, [(file, seed) for file in files for seed in chosen_seeds(SEEDS)]
    ):
        rows.append((file.stem, *row))
        print(f"{file.stem}, seed {seed}: {row[2]:.3f} m", file=sys.stderr, flush=True)
    rows.sort(key=lambda row: row[:2])
    return [Table("Paths of Wild-Places", ("recording", *COLUMNS), tuple(rows))]


def _mapped(task: tuple[Path, int]) -> tuple[int, float, float, float, float, int]:
    """The row of a recording with the odometry of a seed."""
    from tests.benchmarks.tree_manager_folder import read_recorded, write_states

    file, seed = task
    recorded = read_recorded(file)
    with tempfile.TemporaryDirectory(prefix="stemmap-wild-places-") as folder:
        write_states(recorded, Path(folder), 1)
        return mapped_folder(recorded, Path(folder), seed)
