"""CPU time of the mapper per scan, for sensors of 16 to 128 rings, compared with the requirement."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table
from tests.benchmarks.timing import middle, quantile

if TYPE_CHECKING:
    from pipeline.mapper import Mapper
    from pipeline.types.records import Frame, Step

NAME = "scan"
LINE = "The mapper's CPU time for one scan of 16 to 128 rings, stage by stage"

DATA = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
CHUNK = 20  # scans of a run that are mapped in its turn
WARM_SCANS = 5  # mapped but not counted, so that compiled kernels are loaded


@dataclass(frozen=True, slots=True)
class Case:
    """A run: its source, the first counted scan, one past the last, and the number of times that it is
    mapped."""

    name: str
    uri: str
    first: int
    until: int
    times: int = 1


#: The first one is the unit of the ratios. A recording of few scans has only its first second.
CASES = (
    Case("sim:stand, VLP-16", "sim:stand", 20, 320),
    Case("sim:dense, VLP-16", "sim:dense", 20, 120),
    Case("hesai/xt32, 32 rings", "hesai/xt32", 0, 1, 10),
    Case("hesai/40p, 40 rings", "hesai/40p", 0, 1, 10),
    Case("sim:stand, OS1-64", "sim:stand?lidar=os1-64&duration=10", 0, 100),
    Case("kitti, 64 rings", "kitti", 0, 3, 10),
    Case("semantickitti, 64 rings", "semantickitti", 0, 1, 10),
    Case("sim:stand, OS0-128", "sim:stand?lidar=os0-128&duration=10", 0, 100),
)


@dataclass(slots=True)
class Measured:
    """CPU milliseconds of each scan, in total and by stage, and its counts."""

    total: list[float] = field(default_factory=list)
    stage: dict[str, list[float]] = field(default_factory=dict)
    returns: list[int] = field(default_factory=list)
    detections: list[int] = field(default_factory=list)
    landmarks: int = 0
    _now: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def watch(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage of the present scan."""
        begin = time.thread_time()
        try:
            yield
        finally:
            self._now[stage] = self._now.get(stage, 0.0) + 1e3 * (time.thread_time() - begin)

    def map(self, mapper: Mapper, step: Step, *, counts: bool) -> None:
        """Map a scan, and store its times if it is counted."""
        self._now.clear()
        begin = time.thread_time()
        frame = mapper.process(step)
        total = 1e3 * (time.thread_time() - begin)
        if counts:
            self._add(total, frame)

    def _add(self, total: float, frame: Frame) -> None:
        self.total.append(total)
        for stage, ms in (*self._now.items(), ("rest", total - sum(self._now.values()))):
            self.stage.setdefault(stage, []).append(ms)
        self.returns.append(frame.counts["returns"])
        self.detections.append(len(frame.detections.cluster))
        self.landmarks = len(frame.estimate.landmarks)


def run() -> list[Table]:
    """Map the runs in turns; recordings that are absent are left out."""
    cases = [case for case in CASES if case.uri.startswith("sim:") or (DATA / case.uri).exists()]
    measured = [Measured() for _ in cases]
    for case in cases:
        for _ in islice(_mapped(case, Measured()), WARM_SCANS):
            pass
    gc.collect()
    waiting = [_mapped(case, each) for case, each in zip(cases, measured, strict=True)]
    while waiting:
        waiting = [turns for turns in waiting if sum(1 for _ in islice(turns, CHUNK)) == CHUNK]
    unit = middle(measured[0].total)
    stages = list(dict.fromkeys(stage for each in measured for stage in each.stage))
    return [
        Table(
            "Mapper, preset forest, 100 particles, CPU time",
            _COLUMNS,
            tuple(_row(case.name, each, unit) for case, each in zip(cases, measured, strict=True)),
            (
                f"The runs are mapped in turns of {CHUNK} scans. The last three columns are multiples of the "
                f"median of {cases[0].name}. Recordings of few scans are mapped several times, and all their "
                "scans are in the first second, when each scan updates the columns.",
            ),
        ),
        Table(
            "CPU time of each stage: median, p99 and maximum [ms] of the scans that have it",
            ("stage", *(case.name for case in cases)),
            tuple((stage, *(_three(each.stage.get(stage, [])) for each in measured)) for stage in stages),
        ),
    ]


def _mapped(case: Case, measured: Measured) -> Iterator[None]:
    """Map a run and yield after each scan."""
    from pipeline.config import preset
    from pipeline.io.readers import open_source
    from pipeline.mapper import Mapper
    from pipeline.odometry.synchroniser import steps

    uri = case.uri if case.uri.startswith("sim:") else str(DATA / case.uri)
    for _ in range(case.times):
        with closing(open_source(uri)) as source:
            about = source.description
            mapper = Mapper(
                preset("forest"),
                sensor=about.sensor,
                T_base_lidar=about.T_base_lidar,
                seed=0,
                timer=measured.watch,
            )
            given = steps(source.records(), odometry="auto" if about.has_odometry else "static")
            for step in islice(given, case.until):
                measured.map(mapper, step, counts=step.index >= case.first)
                yield


_COLUMNS = (
    "run", "scans", "returns", "detections", "landmarks", "median ms", "p99 ms", "max ms", "median", "p99",
    "max",
)  # fmt: skip


def _row(name: str, m: Measured, unit: float) -> tuple[Cell, ...]:
    figures = (middle(m.total), quantile(m.total, 0.99), max(m.total))
    return (
        name,
        len(m.total),
        round(middle(m.returns)),
        round(middle(m.detections)),
        m.landmarks,
        *figures,
        *(f"{value / unit:.2f}" for value in figures),
    )


def _three(times: list[float]) -> str:
    return f"{middle(times):.2f}, {quantile(times, 0.99):.2f}, {max(times):.2f}" if times else ""
