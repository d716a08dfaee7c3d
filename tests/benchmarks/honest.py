"""Compares the exit code of runs with the truth: `python -m tests.benchmarks honest`.

Simulated drives are mapped without a fault and with the faults of `hostile`, as `stemmap map` does. A map is
wrong if its completeness is more than WORSE points below that of the drive without a fault, or if more than
the share FALSE of its trees are false. Before, the map is aligned with the truth by a rigid motion, because
the frame of a map is that of its first pose. A wrong map with exit code 0 is a fault of the program; exit
code 3 for a drive without a fault is a false alarm.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from tests.benchmarks.hostile import VARIANTS, HostileSource
from tests.benchmarks.table import Cell, Table

if TYPE_CHECKING:
    from pipeline.config.stages import Evaluation
    from pipeline.evaluation import MapScores
    from pipeline.mapper import Mapper
    from pipeline.types.records import Float, Frame, Path, Record, Trees, Truth

SCENES = ("stand", "slope", "dense", "wild", "long")
SEEDS = (1,)
DURATION_S = 40.0
WORSE = 10.0  # points of completeness below the good run
FALSE = 0.2  # share of the trees of a map
OUT = FilePath(__file__).resolve().parents[2] / "docs" / "measurements" / "honest_ends.md"
GOOD = "none"
ITERATIONS = 3  # of the alignment


@dataclass(frozen=True, slots=True)
class Ended:
    """How a run ended.

    Attributes:
        found, of: Number of true trees in the map, and of those within reach of the path.
        false: Trees of the map without a true tree.
        rmse: Position error of the right trees [m]; None without one.
        turn: Rotation of the map about the first pose [rad].
        code: Exit code.
        line: The message with the reason why the map is doubtful; "" without one.
    """

    found: int
    of: int
    false: int
    rmse: float | None
    turn: float
    code: int
    line: str

    def is_wrong(self, good: Ended) -> bool:
        """Whether the map is wrong, see the module."""
        lost = 100.0 * (good.found / max(good.of, 1) - self.found / max(self.of, 1))
        return lost > WORSE or self.false > FALSE * max(self.found + self.false, 1)


def ended(source: HostileSource, choice: str = "auto") -> Ended:
    """Map a source as `stemmap map` does, and compare the map with its truth."""
    from app.batch.map_run import WRONG, OfflineRun, map_run
    from app.batch.summary import exit_code
    from pipeline.config import preset

    about, parameters = source.description, preset(source.description.preset)
    last: list[tuple[Frame, Mapper]] = []

    def mapped(frame: Frame, mapper: Mapper) -> None:
        last[:] = [(frame, mapper)]

    with tempfile.TemporaryDirectory() as folder:
        plan = OfflineRun(source, about.preset, parameters, 0, choice, on_frame=mapped)
        outcome = map_run(plan, FilePath(folder))
    ((frame, mapper),) = last
    truth = source.truth()
    assert truth is not None
    scores, turn = aligned_scores(frame.trees, mapper.path, truth, parameters.evaluation)
    doubts = [text for text in outcome.warnings if text.startswith(WRONG)]
    lines = doubts or [f"left out: {reason} ({n:,})" for reason, n in outcome.losses.items()]
    return Ended(
        scores.TA.count,
        scores.TA.of,
        scores.FA.count + scores.spurious,
        scores.position_rmse,
        turn,
        exit_code(outcome.warnings, outcome.losses, WRONG),
        lines[0] if lines else "",
    )


def aligned_scores(trees: Trees, path: Path, truth: Truth, parameters: Evaluation) -> tuple[MapScores, float]:
    """Return the scores of a map after the rigid motion by which most of its trees are right, and the
    rotation of that motion [rad]. The motion is found from the identity and from the path.

    Args:
        trees, path: The map.
        truth: Its truth.
        parameters: Parameters of the evaluation.
    """
    from pipeline.evaluation import evaluate, match

    assert truth.trees is not None
    assert truth.path is not None
    there = np.stack([truth.trees.x, truth.trees.y], axis=1)
    own = np.stack([path.x, path.y], axis=1)
    true = np.stack(
        [np.interp(path.stamp_ns, truth.path.stamp_ns, c) for c in (truth.path.x, truth.path.y)], axis=1
    )
    best: tuple[int, MapScores, float] | None = None
    for R, t in ((np.eye(2), np.zeros(2)), rigid_motion(own, true)):
        for _ in range(ITERATIONS):
            moved = replace(trees, position=trees.position @ R.T + t)
            scores = evaluate(moved, truth.trees, parameters, own @ R.T + t)
            if best is None or scores.TA.count > best[0]:
                best = (scores.TA.count, scores, float(np.arctan2(R[1, 0], R[0, 0])))
            partner = match(moved.position, there, parameters.match_distance)
            if np.count_nonzero(partner >= 0) < 3:
                break
            R, t = rigid_motion(trees.position[partner >= 0], there[partner[partner >= 0]])
    assert best is not None
    return best[1], best[2]


def rigid_motion(points: Float, onto: Float) -> tuple[Float, Float]:
    """Return the rotation R, shape (2, 2), and the translation t, shape (2,), with the least squares of
    R p + t - q over pairs of points p, q, shape (N, 2) (Kabsch)."""
    p, q = points - points.mean(axis=0), onto - onto.mean(axis=0)
    cross, dot = float(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])), float(np.sum(p * q))
    c, s = np.cos(np.arctan2(cross, dot)), np.sin(np.arctan2(cross, dot))
    R = np.array([[c, -s], [s, c]])
    return R, onto.mean(axis=0) - R @ points.mean(axis=0)


@dataclass(frozen=True, slots=True)
class Plan:
    """Selection of scenes, seeds, kinds of odometry, and parts of the names of the faults; () for all."""

    scenes: tuple[str, ...] = SCENES
    seeds: tuple[int, ...] = SEEDS
    kinds: tuple[str, ...] = ("wheels", "imu", "lidar")
    faults: tuple[str, ...] = ()

    def variants(self, kind: str) -> list[str]:
        """Return the names of the faults for a kind of odometry; the good drive is the first."""
        return [
            name
            for name, variant in VARIANTS.items()
            if kind in variant.kinds
            and (name == GOOD or not self.faults or any(f in name for f in self.faults))
        ]


def runs(plan: Plan) -> Iterator[tuple[str, int, str, str, Ended, Ended]]:
    """Yield scene, seed, kind of odometry, fault, how the run ended, and how the good one ended."""
    from pipeline.io.readers import open_source

    for scene in plan.scenes:
        for seed in plan.seeds:
            mark = "&" if "?" in scene else "?"
            source = open_source(f"sim:{scene}{mark}seed={seed}&duration={DURATION_S:g}")
            records: Sequence[Record] = list(source.records())
            for kind in plan.kinds:
                good = None
                for name in plan.variants(kind):
                    since = time.monotonic()
                    now = ended(HostileSource(source, records, VARIANTS[name], kind=kind))
                    good = good or now
                    print(scene, seed, kind, name, now, f"{time.monotonic() - since:.0f} s", flush=True)
                    yield scene, seed, kind, name, now, good


def verdict(name: str, now: Ended, good: Ended) -> str:
    """Return the verdict on a run: "right", "said" (wrong, with exit code 3), "SILENT" (wrong, with exit code
    0), "careful" (right, with exit code 3), or "FALSE ALARM" (that of a good drive)."""
    if now.is_wrong(good):
        return "said" if now.code == 3 else "SILENT"
    if now.code == 0:
        return "right"
    return "FALSE ALARM" if name == GOOD else "careful"


def table(plan: Plan) -> Table:
    """Run all and return the table."""
    rows: list[tuple[Cell, ...]] = []
    for scene, seed, kind, name, now, good in runs(plan):
        rmse = None if now.rmse is None else 100.0 * now.rmse
        rows.append(
            (scene, seed, kind, name, f"{now.found}/{now.of}", now.false, rmse, float(np.degrees(now.turn)),
             now.code, verdict(name, now, good), now.line)
        )  # fmt: skip
    words = [row[9] for row in rows]
    counted = ", ".join(
        f"{words.count(w)} {w}" for w in ("right", "said", "careful", "FALSE ALARM", "SILENT")
    )
    return Table(
        "Simulated drives",
        (
            "scene", "seed", "odometry", "fault", "found", "false", "position [cm]", "turned [degrees]",
            "exit", "verdict", "line",
        ),
        tuple(rows),
        (f"{len(rows)} runs: {counted}.",),
    )  # fmt: skip


def main(words: list[str]) -> int:
    """Run the benchmark, print the table, and write it with --out.

    Returns:
        1 if a wrong map ended with exit code 0, else 0.
    """
    parser = argparse.ArgumentParser("python -m tests.benchmarks honest", description=__doc__)
    parser.add_argument(
        "--scenes", default=",".join(SCENES), help="names of scenarios (default: %(default)s)"
    )
    parser.add_argument("--seeds", default="1", help="such as 1-3 (default: %(default)s)")
    parser.add_argument(
        "--odometry", default="wheels,imu,lidar", help="kinds of odometry (default: %(default)s)"
    )
    parser.add_argument("--faults", default="", help="parts of names of faults (default: all)")
    parser.add_argument("--out", type=FilePath, help=f"also write the table, for instance to {OUT.name}")
    chosen = parser.parse_args(words)
    first, _, last = chosen.seeds.partition("-")
    plan = Plan(
        tuple(chosen.scenes.split(",")),
        tuple(range(int(first), int(last or first) + 1)),
        tuple(chosen.odometry.split(",")),
        tuple(filter(None, chosen.faults.split(","))),
    )
    done = table(plan)
    print(done.markdown())
    if chosen.out is not None:
        command = " ".join(["python -m tests.benchmarks honest", *words])
        chosen.out.write_text(f"# Honest ends\n\n`{command}`, {date.today()}.\n\n{done.markdown()}\n")
    return int(any(row[9] == "SILENT" for row in done.rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
