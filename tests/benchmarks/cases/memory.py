"""Whether memory grows over a long run by more than the path and the map."""

from __future__ import annotations

import gc
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

from tests.benchmarks.machine import peak_mib, resident_mib
from tests.benchmarks.table import Cell, Table, verdict

if TYPE_CHECKING:
    from pipeline.classification.voxel_map import VoxelMap
    from pipeline.mapper import Mapper

NAME = "memory"
LINE = "Memory over sim:long, ten minutes of driving"

EVERY = 1_000  # scans between two readings
ALLOWED_MIB = 8.0  # memory that an allocator may keep; a leak of one scan in a thousand would exceed it


def run() -> list[Table]:
    """Map sim:long and read the memory during the run."""
    readings = follow("sim:long", EVERY)
    first, last = readings[0], readings[-1]
    growth = (last[1] - last[2]) - (first[1] - first[2])
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (scans, resident, known, resident - known, landmarks)
        for scans, resident, known, landmarks in readings
    )
    return [
        Table(
            "VoxelMap of the process while it simulates and maps sim:long, preset forest",
            ("scans", "resident MiB", "path and map MiB", "the rest MiB", "landmarks"),
            rows,
            (
                f"From scan {first[0]:,} to {last[0]:,} the rest grew by {growth:.2f} MiB, "
                f"{growth * 1024 / max(last[0] - first[0], 1):.2f} KiB a scan; asked for: no growth "
                f"(at most {ALLOWED_MIB:g} MiB, which allocators may keep): "
                f"{verdict(growth <= ALLOWED_MIB)}.",
                f"Peak of the process: {peak_mib():.0f} MiB.",
            ),
        )
    ]


def follow(uri: str, every: int) -> list[tuple[int, float, float, int]]:
    """Map a source; return scans, resident memory, memory of path and map [MiB], and landmarks at each
    reading."""
    from pipeline.config import preset
    from pipeline.io.readers import open_source
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps

    source = open_source(uri)
    described = source.description
    mapper = Mapper(preset("forest"), sensor=described.sensor, T_base_lidar=described.T_base_lidar, seed=0)
    readings = []
    for step in steps(source.records()):
        frame = mapper.process(step)
        if (step.index + 1) % every == 0:
            gc.collect()
            resident = resident_mib()  # read before the size of the map, which copies it
            readings.append((step.index + 1, resident, _known_mib(mapper), len(frame.estimate.landmarks)))
    return readings


def _known_mib(mapper: Mapper) -> float:
    # The collected voxels are stored twice: at present, and at the last fold.
    voxels = in_use_bytes(mapper._columns.memory)
    return (array_bytes(mapper.snapshot()) + array_bytes(mapper.path) + voxels) / 2**20


def in_use_bytes(memory: VoxelMap) -> int:
    """Bytes of the used rows of a memory and of its tables; capacity that was never filled has no pages."""
    rows = (memory.key, memory.mean, memory.returns, memory.scans, memory.latest, memory.following)
    used = sum(column[: memory.used].nbytes for column in (*rows, memory.home))
    return used + memory.slot.nbytes + memory.tile_slot.nbytes


def array_bytes(record: Any) -> int:
    """Bytes of all arrays in a record and the records in it."""
    if hasattr(record, "nbytes"):
        return int(record.nbytes)
    if is_dataclass(record):
        return sum(array_bytes(getattr(record, f.name)) for f in fields(record))
    if isinstance(record, tuple | list):
        return sum(array_bytes(part) for part in record)
    return 0
