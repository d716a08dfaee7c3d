"""A short simulated run, and a mapper for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from pipeline.config import Parameters, preset
from pipeline.io.readers import open_source
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.remapping import Basis
from pipeline.remapping.notes import Notes, Stretch
from pipeline.types.records import Bool

URI = "sim:paper?duration=6&odometry=poor"
BASE = preset("forest")
SPACING = 7


@cache
def run():
    """The steps of a short simulated run, and its source's description."""
    source = open_source(URI)
    return list(steps(source.records())), source.description


def mapper(parameters: Parameters) -> Mapper:
    """Fresh, for the simulated run."""
    d = run()[1]
    return Mapper(parameters, sensor=d.sensor, T_base_lidar=d.T_base_lidar, seed=3)


def noted(basis: Basis, change: Callable[[Stretch], Stretch]) -> Basis:
    """With other notes."""
    return replace(basis, notes=Notes(tuple(map(change, basis.notes.stretches))))


def with_odd(basis: Basis, odd: Bool) -> Basis:
    """As if the pose of some scans had hung on the trees."""
    left = iter(~odd)

    def change(stretch: Stretch) -> Stretch:
        return replace(stretch, is_usual=np.array([next(left) for _ in range(len(stretch))]))

    return noted(basis, change)


def ungathered(basis: Basis) -> Basis:
    """As if nothing had been gathered of any scan."""

    def change(stretch: Stretch) -> Stretch:
        nowhere = np.zeros(len(stretch), np.bool_)
        return replace(stretch, recorded=stretch.recorded._replace(gathered=nowhere))

    return noted(basis, change)
