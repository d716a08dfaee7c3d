"""CPU time of the detection of trunks in one scan, from the ground to the verdict."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table, verdict
from tests.benchmarks.timing import middle, quantile

if TYPE_CHECKING:
    from pipeline.types.records import Sensor, Step

NAME = "detection"
LINE = "From the ground to the verdict, one scan of a VLP-16 and of 64 rings"

DATA = Path(os.environ.get("STEMMAP_DATA", "../shared/data"))
STAGES = ("ground", "voxel grid", "clustering", "shape", "free view", "detection")
VLP16_MS, RINGS_64_MS = 2.0, 15.0  # asked for
VLP16_SCANS, EVERY = 500, 5
WARM, ROUNDS = 1, 20  # number of passes over the scans


class StageClock:
    """The `Watch` of the mapper: CPU milliseconds of each stage, one entry per scan."""

    def __init__(self) -> None:
        self.ms: dict[str, list[float]] = {stage: [] for stage in STAGES}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Measure one stage; stages that do not belong to detection are ignored."""
        start = time.thread_time()
        yield
        if stage in self.ms:
            self.ms[stage].append(1e3 * (time.thread_time() - start))

    def scans(self) -> list[float]:
        """Total milliseconds of each scan."""
        return [sum(stages) for stages in zip(*self.ms.values(), strict=True)]


def run() -> list[Table]:
    """Scans of the simulated stand and, if the recordings exist, of a street with 64 rings."""
    cases = [("sim:stand, VLP-16", VLP16_MS, _steps("sim:stand", VLP16_SCANS, EVERY))]
    for folder in ("kitti", "semantickitti"):
        if (DATA / folder).is_dir():
            cases.append((f"{folder}, 64 rings", RINGS_64_MS, _steps(str(DATA / folder), 10, 1)))
    clocks = [(name, asked, len(found[1]), *_measured(*found)) for name, asked, found in cases]
    reached = "; ".join(
        f"{name}: at most {asked:g} ms {verdict(middle(clock.scans()) <= asked)}"
        for name, asked, _, clock, _ in clocks
    )
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (name, scans, returns, clusters, middle(clock.scans()), quantile(clock.scans(), 0.99))
        for name, _, scans, clock, (returns, clusters) in clocks
    )
    stages: tuple[tuple[Cell, ...], ...] = tuple(
        (stage, *(middle(clock.ms[stage]) for *_, clock, _ in clocks)) for stage in STAGES
    )
    return [
        Table(
            "Ground, voxel grid, clustering, shape and verdict by CPU time, preset forest",
            ("run", "scans", "returns", "clusters", "median ms", "p99 ms"),
            rows,
            (f"Asked for, as medians on one core: {reached}.",),
        ),
        Table("Median of each stage", ("stage", *(f"{name} ms" for name, *_ in clocks)), stages),
    ]


def _steps(uri: str, until: int, every: int) -> tuple[Sensor, list[Step]]:
    """The sensor, and every n-th step of a run up to a scan."""
    from contextlib import closing

    from pipeline.io.readers import open_source
    from pipeline.odometry.synchroniser import steps

    with closing(open_source(uri)) as source:
        about = source.description
        taken = []
        for step in steps(source.records(), odometry="auto" if about.has_odometry else "static"):
            if step.index >= until:
                break
            if step.index % every == 0:
                taken.append(step)
        return about.sensor, taken


def _measured(sensor: Sensor, run: Sequence[Step]) -> tuple[StageClock, tuple[int, int]]:
    """Times of repeated passes over the scans, and their median numbers of returns and clusters."""
    from pipeline.config import preset
    from pipeline.front_end import detect, segment
    from pipeline.geometry.poses import Pose3

    parameters = preset("forest")
    clock, returns, clusters = StageClock(), [], []
    for turn in range(WARM + ROUNDS):
        clock = StageClock() if turn == WARM else clock
        gc.collect()
        for step in run:
            scan = segment(step, sensor, Pose3.identity(), parameters, clock)
            seen = detect(scan, parameters.detection, clock)
            returns.append(len(step.scan.points))
            clusters.append(len(seen.clusters.size))
    return clock, (round(middle(returns)), round(middle(clusters)))
