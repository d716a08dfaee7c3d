"""A short simulated run, and a mapper for it."""

from __future__ import annotations

from functools import cache

from pipeline.config import Parameters, preset
from pipeline.io.readers import open_source
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.remapping.rerun import Rerun, ScanCache
from pipeline.types.records import Frame, Step

URI = "sim:paper?duration=6&odometry=poor"
BASE = preset("forest")


@cache
def run():
    """The steps of a short simulated run, and the description of its source."""
    source = open_source(URI)
    return list(steps(source.records())), source.description


def mapper(parameters: Parameters) -> Mapper:
    """A fresh mapper for the simulated run."""
    d = run()[1]
    return Mapper(parameters, sensor=d.sensor, T_base_lidar=d.T_base_lidar, seed=3)


def fill(cache: ScanCache, parameters: Parameters, parts: list[Step]) -> ScanCache:
    """Cache scans that are segmented with some parameters."""
    m = mapper(parameters)
    for step in parts:
        cache.put(step, m.segment(step))
    return cache


def frames(rerun: Rerun, scans: int) -> list[Frame]:
    """Frames of a rerun up to so many scans."""
    return [rerun.map_next() for _ in range(scans - rerun.done)]
