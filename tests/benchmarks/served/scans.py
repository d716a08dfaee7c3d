"""A recording whose scans have 30,000 returns: a simulated stand, seen by a sensor of 32 rings."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

RINGS = 32
DURATION_S = 26


def write(path: Path) -> float:
    """Write the recording; return the mean number of returns per scan."""
    from pipeline.io.readers.simulated import SimulatedSource
    from pipeline.io.recording.mcap_writer import write_recording
    from pipeline.simulation.lidar import SpinningLidar
    from pipeline.simulation.run import open_run
    from pipeline.simulation.scenarios import parse_uri
    from pipeline.types.records import Scan

    uri = f"sim:stand?duration={DURATION_S}"
    lidar = SpinningLidar(rings=RINGS, ring_step=float(np.radians(1.0)))
    run = dataclasses.replace(open_run(parse_uri(uri)), lidar=lidar)
    source = SimulatedSource(uri, run)
    records = list(source.records())
    described = source.description
    write_recording(
        path, records, sensor=described.sensor, T_base_lidar=described.T_base_lidar, truth=source.truth()
    )
    return float(np.mean([len(record.points) for record in records if isinstance(record, Scan)]))
