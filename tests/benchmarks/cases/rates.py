"""The same drives recorded at 5, 10 and 20 Hz: the map must not depend on the rate of the sensor."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from pipeline.types.records import Frame

NAME = "rates"
LINE = "The same drives recorded at 5, 10 and 20 Hz: trees, position, DBH, path"
#: A stand, and one of `sim:wild`, whose seeds 0 to 19 are for scoring only.
DRIVES = ("sim:stand?seed=1&duration=60", "sim:wild?seed=101")
FASTEST_NS, RATES = 50_000_000, {20: 1, 10: 2, 5: 4}  # period of 20 Hz; every n-th scan of it
SEEDS = (0, 1)


def run() -> list[Table]:
    """A row of each drive, rate and seed of SLAM."""
    rows = [row for uri in DRIVES for row in _drive(uri)]
    columns = (
        "drive", "rate [Hz]", "seed", "found", "of", "false", "position RMSE [cm]", "DBH RMSE [cm]",
        "path RMS [cm]",
    )  # fmt: skip
    return [Table(LINE, columns, tuple(rows))]


def _drive(uri: str) -> Iterator[tuple[Cell, ...]]:
    import numpy as np

    from pipeline.config import preset
    from pipeline.evaluation import evaluate, path_error
    from pipeline.io.readers.simulated import SimulatedSource, open_simulated
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps

    made = open_simulated(uri).run
    lidar = replace(made.lidar, period_ns=FASTEST_NS)
    scans = made.scans * made.lidar.period_ns // FASTEST_NS
    source = SimulatedSource(uri, replace(made, lidar=lidar, scans=scans))
    about, truth, parameters = source.description, source.truth(), preset("forest")
    assert truth.trees is not None
    assert truth.path is not None
    for rate, every in RATES.items():
        mappers = [
            Mapper(parameters, sensor=about.sensor, T_base_lidar=about.T_base_lidar, seed=seed)
            for seed in SEEDS
        ]
        frames: list[Frame] = []
        for step in steps(source.records(every=every)):
            scan = mappers[0].segment(step)
            frames = [mapper.process(step, scan) for mapper in mappers]
        for seed, mapper, frame in zip(SEEDS, mappers, frames, strict=True):
            path = np.stack([mapper.path.x, mapper.path.y], axis=1)
            e = evaluate(frame.trees, truth.trees, parameters.evaluation, path)
            off = path_error(mapper.path, truth.path, align=True)
            values = (e.position_rmse, e.dbh_rmse, None if off is None else off.rms)
            print(f"{uri}, {rate} Hz, seed {seed}: {e.TA.count} trees", file=sys.stderr, flush=True)
            yield (
                uri, rate, seed, e.TA.count, e.TA.of, e.FA.count + e.spurious,
                *(None if v is None else 100.0 * v for v in values),
            )  # fmt: skip
