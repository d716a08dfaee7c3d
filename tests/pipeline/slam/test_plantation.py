"""Trees in rows, which look the same one spacing further: correct odometry is kept, and stuck wheels are
detected."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from pipeline.geometry.poses import Pose2, Pose3
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.types.records import Float
from tests.benchmarks.troubled import KNOWN, SENSOR, TROUBLES, Place, Trouble, drive, parameters


@dataclass(frozen=True, slots=True)
class Plantation(Place):
    """Rows `pitch` apart, as far as the trees in them; the way runs between two rows. One tree of twenty is
    gone, the others stand `jitter` beside their place (one sigma) [m]."""

    pitch: float = 3.0
    jitter: float = 0.1

    def trees(self, seed: int) -> Float:
        """Where they stand, shape (N, 2) [m]."""
        rng = np.random.default_rng([9, seed])
        way = np.array([[p.x, p.y] for p in self.path()])
        low = np.floor((way.min(axis=0) - 13.0) / self.pitch)
        high = np.ceil((way.max(axis=0) + 13.0) / self.pitch)
        along, across = (np.arange(a, b + 1.0) * self.pitch for a, b in zip(low, high, strict=True))
        grid = np.stack(np.meshgrid(along, across + 0.5 * self.pitch), axis=-1).reshape(-1, 2)
        planted = grid + rng.normal(0.0, self.jitter, grid.shape)
        return np.asarray(planted[rng.random(len(planted)) < 0.95])


def mapped(place: Place, trouble: Trouble, seed: int) -> tuple[Float, list[str], int]:
    """The position's error at each scan, all warnings, and the trees that are none."""
    driven = drive(place, seed, trouble)
    mapper = Mapper(parameters(), sensor=SENSOR, T_base_lidar=Pose3.identity(), seed=seed)
    frames = [mapper.process(step) for step in steps(driven.records)]
    error = np.array([driven.error(k, frame.estimate.T_map_base) for k, frame in enumerate(frames)])
    trees = frames[-1].trees
    false = driven.false_trees(trees.position[trees.confirmed], float(error[-1]))
    return error, [w for frame in frames for w in frame.warnings], false


@pytest.mark.slow_after(2)
@pytest.mark.parametrize("jitter", [0.0, 0.15])
@pytest.mark.parametrize(("stride", "pitch"), [(0.1, 2.0), (0.3, 3.0), (0.3, 4.0)])
def test_rows_of_trees_do_not_contradict_a_correct_odometry(
    stride: float, pitch: float, jitter: float
) -> None:
    place = Plantation(Pose2(stride), 0.0, pitch=pitch, jitter=jitter)
    error, warnings, false = mapped(place, Trouble(), 1)
    assert error.max() < 0.2
    assert not [w for w in warnings if "trees lead" in w]
    assert false == 0


@pytest.mark.parametrize("pitch", [2.0, 3.0])
def test_stuck_wheels_are_detected_between_rows_of_trees(pitch: float) -> None:
    place = Plantation(Pose2(0.1), 0.0, pitch=pitch)
    error, warnings, false = mapped(place, TROUBLES["stuck"], 2)
    assert len([w for w in warnings if "it is stuck" in w]) > KNOWN
    assert error.max() < 0.2
    assert false == 0
