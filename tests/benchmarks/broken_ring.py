"""A broken ring for people to repair: `python -m tests.benchmarks.broken_ring FOLDER [SEED]`.

The folder contains the scans of the ring as detected stems, in the format of
`app.extensions.formats.tree_manager`. Next to it, FOLDER.txt lists the ten faults of the map in the words of
a person who knows the stand, and FOLDER.csv contains the true trees, in metres in the frame of the first
pose. The map is broken if no loop is closed: `stemmap FOLDER --set relocalisation.method=none`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.extensions.formats.tree_manager import TRAJECTORY, state_name, state_text, trajectory_text
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.types.records import Float
from tests.benchmarks.wide_ring import WideRing

POLES = np.array([[8.0, 3.0], [16.0, -2.5], [22.0, 10.0]])
GHOSTS = np.array([[3.0, -3.0], [14.0, 6.5]])
TWIN = np.array([0.2, 0.1])  # m, between two stems that are one tree in the map
DOUBLE = np.array([0.9, 0.0])  # m, between a stem and its false copy
CLEAR = 2.0  # m, of other stems around each fault


@dataclass(frozen=True, slots=True)
class FaultyRing(WideRing):
    """A ring with poles, false trees, two false copies of trees, and a tree with two stems."""

    def scene(self, random: np.random.Generator) -> tuple[Float, Float, Float]:
        """Return the true trees, those with a false copy, and the one with a twin."""
        trees = WideRing.trees(self, random)
        away = np.hypot(*(trees[:, None] - np.concatenate([POLES, GHOSTS])[None]).transpose(2, 0, 1))
        trees = trees[away.min(axis=1) > CLEAR]
        apart = np.hypot(*(trees[:, None] - trees[None]).transpose(2, 0, 1)) + 9.0 * np.eye(len(trees))
        on_way = np.abs(np.hypot(trees[:, 0], trees[:, 1] - self.radius) - self.radius)
        lone = np.flatnonzero((apart.min(axis=1) > CLEAR) & (on_way > CLEAR) & (trees[:, 0] > 5.0))
        return trees, trees[lone[:2]], trees[lone[2]]

    def trees(self, random: np.random.Generator) -> Float:
        trees, copied, twin = self.scene(random)
        return np.concatenate([trees, copied + DOUBLE, (twin + TWIN)[None], POLES, GHOSTS])


def write_ring(folder: Path, seed: int) -> None:
    """Write the scans of a ring, the list of its faults, and its true trees.

    Args:
        folder: A new folder.
        seed: Seed of the ring.
    """
    folder.mkdir(parents=True)
    ring, poses, stamps = FaultyRing(), list[Pose3](), list[int]()
    for step, _ in ring.steps(seed):
        stems = step.scan.stems
        assert stems is not None
        assert step.T_odom_base is not None
        rows: list[list[float | bool]] = [
            [*np.eye(3).ravel().tolist(), *place.tolist(), dbh, dbh, 1.0, True, 1]
            for place, dbh in zip(step.scan.points.astype(np.float64), stems.dbh.tolist(), strict=True)
        ]
        (folder / state_name(step.index)).write_text(state_text(rows))
        poses.append(lifted(step.T_odom_base))
        stamps.append(step.scan.stamp_ns)
    (folder / TRAJECTORY).write_text(trajectory_text(np.array(stamps), poses))
    trees, copied, twin = ring.scene(np.random.default_rng([9, seed]))
    folder.with_suffix(".txt").write_text("\n".join(faults(copied, twin)) + "\n")
    standing = np.concatenate([trees, (twin + TWIN)[None]])
    np.savetxt(folder.with_suffix(".csv"), standing, "%.2f", ",", header="x,y", comments="")


def lifted(pose: Pose2) -> Pose3:
    """A planar pose at height 0."""
    return Pose3.from_euler(np.array([pose.x, pose.y, 0.0]), 0.0, 0.0, pose.yaw)


def faults(copied: Float, twin: Float) -> list[str]:
    """Return descriptions of the faults with true positions [m]."""
    lines = [
        "Places are surveyed from the start of the drive; the map shows them up to some metres beside.",
        "The end of the drive passes the trees of its start again, but the map shows them a second time.",
    ]
    for tree in copied:
        lines.append(f"The tree at {_words(tree)} stands twice: a second one at {_words(tree + DOUBLE)}.")
    lines += [f"At {_words(place)} stands a pole, not a tree." for place in POLES]
    lines += [f"At {_words(place)} stands nothing." for place in GHOSTS]
    lines.append(f"At {_words(twin)} stand two trees, {100 * np.hypot(*TWIN):.0f} cm apart; the map has one.")
    lines.append(f"The first of these two stands exactly at {_words(twin)}.")
    return lines


def _words(place: Float) -> str:
    return f"x {place[0]:.2f}, y {place[1]:.2f}"


if __name__ == "__main__":
    write_ring(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0)
