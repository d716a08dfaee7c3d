"""The cloud of a real plot, scanned virtually by a robot that drives through it."""

from __future__ import annotations

import os
from pathlib import Path

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Table

NAME = "plot"
LINE = "A real plot with a VLP-16 driven through it (needs STEMMAP_DATA); whole clouds: rivals"
SEEDS = range(3)
SPREAD = 4.0  # cm; a diameter is scored where the reference programs agree within this
MATCH = 0.5  # m


def run() -> list[Table]:
    """Drives with exact and with normal odometry."""
    from pipeline.errors import StemmapError

    folder = Path(os.environ.get("STEMMAP_DATA", "../shared/data")) / "forest"
    if not (folder / "pine_plot.laz").is_file():
        raise StemmapError("there is no real data", where=str(folder), remedy="Set STEMMAP_DATA")
    return [_driven(folder)]


SCORES = (
    "found",
    "of",
    "position RMSE [cm]",
    "DBH RMSE [cm]",
    "DBH bias [cm]",
    "DBH scored",
    "their position [cm]",
)
_NO_SCORES = (None,) * len(SCORES)


def stem_scores(place, dbh, table: Path) -> tuple[int | float | None, ...]:
    """Found stems of the table, position error, diameter error of the scored stems, and position error of
    these stems."""
    import csv

    import numpy as np

    from pipeline.evaluation import match

    if not table.is_file():
        return _NO_SCORES
    with table.open(newline="") as file:
        stems = list(csv.DictReader(file))
    truth = np.array([[float(s["x_m"]), float(s["y_m"])] for s in stems])
    return _against(place, dbh, truth, stems, match(place, truth, MATCH))


def _against(place, dbh, truth, stems, truth_of) -> tuple[int | float | None, ...]:
    import numpy as np

    found = truth_of >= 0
    off = np.hypot(*(place[found] - truth[truth_of[found]]).T)
    tape = np.array([float(s["dbh_cm"]) if 0.0 < float(s["spread_cm"]) <= SPREAD else np.nan for s in stems])
    wider = 100.0 * dbh[found] - tape[truth_of[found]]
    scored = np.isfinite(wider)
    wider = wider[scored]
    return (
        int(found.sum()),
        len(truth),
        100.0 * float(np.sqrt(np.mean(off**2))),
        float(np.sqrt(np.mean(wider**2))) if len(wider) else None,
        float(wider.mean()) if len(wider) else None,
        len(wider),
        100.0 * float(np.sqrt(np.mean(off[scored] ** 2))) if len(wider) else None,
    )


def _driven(folder: Path) -> Table:
    import csv
    from contextlib import closing

    import numpy as np

    from pipeline.config import preset
    from pipeline.evaluation import match
    from pipeline.io.readers import open_source
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps

    table = folder / "pine_plot_stems.csv"
    with table.open(newline="") as file:
        stems = list(csv.DictReader(file))
    rows = []
    for odometry in ("exact", "normal"):
        for seed in chosen_seeds(SEEDS):
            uri = f"sim:cloud?file={folder / 'pine_plot.laz'}&truth={table}&odometry={odometry}&seed={seed}"
            with closing(open_source(uri)) as source:
                about, known = source.description, source.truth()
                mapper = Mapper(
                    preset("forest"), sensor=about.sensor, T_base_lidar=about.T_base_lidar, seed=seed
                )
                frame = [mapper.process(step) for step in steps(source.records())][-1]
            assert known is not None
            assert known.trees is not None
            truth = np.stack([known.trees.x, known.trees.y], axis=1)
            kept = frame.trees.confirmed
            place = frame.trees.position[kept]
            scores = _against(place, frame.trees.dbh[kept], truth, stems, match(place, truth, MATCH))
            rows.append((odometry, seed, len(place), *scores))
    columns = ("odometry", "seed", "trees", *SCORES)
    return Table("pine_plot.laz scanned virtually", columns, tuple(rows))
