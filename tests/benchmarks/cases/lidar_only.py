"""Motion from the LiDAR alone: simulated drives without wheels and IMU, compared with the same drives with
both.

Even seeds drive at 2 m/s, odd ones at 0.5 m/s; of four seeds in a row, the last two have a solid-state LiDAR
with a field of view of 70 degrees. Each drive has two standstills of 10 s, and a turn on the spot by 115
degrees and back at up to 60 degrees/s.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from pipeline.io.readers.simulated import SimulatedSource
    from pipeline.types.records import Record

NAME = "lidar_only"
LINE = "Drift of the path and trees of drives without wheels and IMU, seeds 0 to 9 of four stands"
SCENES = ("stand", "slope", "dense", "wild")
SEEDS = range(10)
DURATION_S = 40.0
FAST, SLOW = 2.0, 0.5  # m/s
#: The drift is a share of the driven path; shorter paths count as this length [m].
SHORTEST = 10.0
#: A map counts as wrong without a warning from this many points of completeness or correctness below that
#: with wheels.
WORSE = 10.0


@dataclass(frozen=True, slots=True)
class Drive:
    """Result of a drive: driven path [m], largest distance of the path from the true one [m], completeness
    and correctness [%], and the number of warnings."""

    way: float
    largest: float
    completeness: float
    correctness: float
    warnings: int


def run() -> list[Table]:
    """All stands and seeds."""
    import numpy as np

    from tests.benchmarks.lidar_drives import lidar_drive

    rows, drifts, apart, silent = list[tuple[Cell, ...]](), list[float](), list[float](), 0
    for scene in SCENES:
        for seed in chosen_seeds(SEEDS):
            speed, one_way = (SLOW if seed % 2 else FAST), seed % 4 >= 2
            source = lidar_drive(scene, seed, speed, DURATION_S, one_way=one_way)
            records = list(source.records())
            alone, wheels = (_mapped(source, records, alone=alone) for alone in (True, False))
            drift = 100.0 * alone.largest / max(alone.way, SHORTEST)
            gaps = (wheels.completeness - alone.completeness, wheels.correctness - alone.correctness)
            drifts.append(drift)
            apart.append(max(gaps))
            silent += max(gaps) > WORSE and alone.warnings == 0
            row = (
                scene, seed, speed, "70 degrees" if one_way else "VLP-16", alone.way, alone.largest, drift,
                100.0 * wheels.largest / max(wheels.way, SHORTEST), alone.completeness, wheels.completeness,
                alone.correctness, wheels.correctness, alone.warnings,
            )  # fmt: skip
            print(" ".join(str(cell) for cell in row), file=sys.stderr, flush=True)
            rows.append(row)
    columns = (
        "stand", "seed", "speed [m/s]", "sensor", "path [m]", "largest error [m]", "drift [%]",
        "drift with wheels [%]", "completeness [%]", "with wheels [%]", "correctness [%]", "with wheels [%]",
        "warnings",
    )  # fmt: skip
    notes = (
        f"Drift: largest distance from the true path as a share of the path (of at least {SHORTEST:.0f} m): "
        f"median {np.median(drifts):.2f} %, worst {max(drifts):.2f} %.",
        f"Completeness or correctness below that with wheels and IMU: median {np.median(apart):.1f} points, "
        f"worst {max(apart):.1f}.",
        f"Drives that are more than {WORSE:.0f} points worse without a warning: {silent}.",
    )
    return [Table(LINE, columns, tuple(rows), notes)]


def _mapped(source: SimulatedSource, records: Iterable[Record], *, alone: bool) -> Drive:
    """Map the records of a drive, by the LiDAR alone or with wheels and IMU."""
    import numpy as np

    from pipeline.config import preset
    from pipeline.evaluation import evaluate
    from pipeline.mapper import Mapper
    from pipeline.odometry.lidar_odometry import LidarOdometry
    from pipeline.odometry.synchroniser import steps
    from tests.benchmarks.lidar_drives import lidar_records

    about, truth, parameters = source.description, source.truth(), preset("forest")
    assert truth.trees is not None
    assert truth.path is not None
    if alone:
        motion = LidarOdometry(about.T_base_lidar, about.sensor)
        records = (told for record in lidar_records(records) for told in motion.add(record))
    mapper = Mapper(parameters, sensor=about.sensor, T_base_lidar=about.T_base_lidar, seed=0)
    warnings = set[str]()
    frames = (mapper.process(step) for step in steps(records))
    frame = next(frames)
    for frame in frames:
        warnings.update(frame.warnings)
    path = np.stack([mapper.path.x, mapper.path.y], axis=1)
    there = np.stack([truth.path.x, truth.path.y], axis=1)[: len(path)]
    e = evaluate(frame.trees, truth.trees, parameters.evaluation, path)
    return Drive(
        float(np.hypot(*np.diff(there, axis=0).T).sum()),
        float(np.hypot(*(path - there).T).max()),
        100.0 * (e.completeness or 0.0),
        100.0 * (e.correctness or 0.0),
        len(warnings),
    )
