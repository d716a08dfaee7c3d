"""A short simulated run, and a mapper for it."""

from __future__ import annotations

from functools import cache

from pipeline.mapper import Mapper
from pipeline.parameters import Parameters, preset
from pipeline.sources import open_source
from pipeline.steps import steps

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
