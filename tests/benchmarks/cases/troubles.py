"""Faults: the map when odometry or scans are faulty, in five places, twenty drives each."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from tests.benchmarks.troubled import Place, Trouble

NAME = "troubles"
LINE = "Bad odometry and bad scans, twenty drives each: error, false trees, what is said"
SEEDS = range(4)
DRIVE_SEEDS = range(10)
DRIFT, WRONG = 0.3, 0.5  # m; maximum offset of the map, and the offset from which a tree is another one


@dataclass(frozen=True, slots=True)
class MappingResult:
    """Result of one drive: error of the pose at its end [m], false trees, whether there was a warning within
    the allowed number of scans, and the state at the end."""

    error: float
    false: int
    warned: bool
    state: str

    @property
    def is_silent(self) -> bool:
        """Whether the map is wrong without a warning."""
        return self.state == "good" and (self.error > WRONG or self.false > 1)


def run() -> list[Table]:
    """One row per fault."""
    import numpy as np

    from tests.benchmarks.troubled import PLACES, TROUBLES

    rows: list[tuple[Cell, ...]] = []
    for name, trouble in TROUBLES.items():
        done = [outcome(place, seed, trouble) for place in PLACES.values() for seed in chosen_seeds(SEEDS)]
        errors = [one.error for one in done]
        rows.append(
            (name, len(done), sum(one.warned for one in done), float(np.median(errors)), max(errors),
             max(one.false for one in done), *(sum(one.state == word for one in done) for word in WORDS),
             sum(one.is_silent for one in done))
        )  # fmt: skip
        print(f"{name}: worst {max(errors):.2f} m", file=sys.stderr, flush=True)
    columns = (
        "trouble", "drives", "warned of", "median error [m]", "worst [m]", "most false trees",
        *(f"{word} in the end" for word in WORDS), "wrong without a word",
    )  # fmt: skip
    return [
        Table(
            LINE,
            columns,
            tuple(rows),
            (
                f"Ready stems in {len(PLACES)} places (0.03 to 0.2 trees a square metre, 1 and 3 m/s, "
                "straight and on a circle), 40 scans before the trouble and 55 since it began; error of the "
                "pose at the end, false: where no tree stands, or one has another already.",
            ),
        ),
        _drives(),
    ]


def _drives() -> Table:
    """Odometry faults in drives with whole scans."""
    from tests.benchmarks.faulty_odometry import FAULTS, MATCH, SECONDS, WRONG, SimulatedDrive

    drives = [SimulatedDrive(seed) for seed in chosen_seeds(DRIVE_SEEDS)]
    rows: list[tuple[Cell, ...]] = []
    for name, fault in FAULTS.items():
        done = [drive.mapped(fault) for drive in drives]
        rows.append(
            (name, len(done), max(one.error for one in done), max(one.false for one in done),
             max(one.missing for one in done), sum(one.silent > 0 for one in done))
        )  # fmt: skip
        print(f"{name}: worst {rows[-1][2]:.2f} m, {rows[-1][3]} false", file=sys.stderr, flush=True)
    return Table(
        f"Faults of the odometry in sim:stand, {SECONDS:g} s, whole scans",
        (
            "odometry",
            "drives",
            "largest error [m]",
            "most false trees",
            "most missing trees",
            "wrong without a word",
        ),
        tuple(rows),
        (
            f"Largest error of the reported position in any scan; a false tree has no true tree within "
            f"{MATCH} m. Wrong without a word: drives with a scan whose position is off by more than {WRONG} "
            "m while the pose quality is good.",
        ),
    )


WORDS = ("good", "weak", "lost")


def outcome(place: Place, seed: int, trouble: Trouble) -> MappingResult:
    """Map one drive."""
    from pipeline.geometry.poses import Pose3
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps
    from tests.benchmarks.troubled import KNOWN, SENSOR, drive, parameters

    driven = drive(place, seed, trouble)
    mapper = Mapper(parameters(), sensor=SENSOR, T_base_lidar=Pose3.identity(), seed=seed)
    frames = [mapper.process(step) for step in steps(driven.records)]
    first = 0 if trouble.from_start else KNOWN
    soon = frames[first : first + trouble.soon + 1]
    last = frames[-1]
    error = driven.error(len(driven.truth) - 1, last.estimate.T_map_base)
    trees = last.trees.position[last.trees.confirmed]
    return MappingResult(
        error,
        driven.false_trees(trees, min(error, DRIFT)),
        any(trouble.said in word for frame in soon for word in frame.warnings),
        last.health.state,
    )
