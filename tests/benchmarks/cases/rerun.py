"""The whole run mapped again after a change of one parameter, against mapping it from its scans."""

from __future__ import annotations

import gc
import time
from contextlib import closing
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tests.benchmarks.table import Cell, Table, verdict

if TYPE_CHECKING:
    from pipeline.config import Parameters
    from pipeline.io.readers.base import Source
    from pipeline.mapper import Mapper
    from pipeline.remapping import Basis, KeptScans, Sample
    from pipeline.types.records import Step

NAME = "rerun"
LINE = "The whole run mapped again after a change, from what its scans showed"

URI, SCANS = "sim:long", 6000
READ_AGAIN = 1000  # scans that are held in memory, for changes that look at the points again
ASKED_ROUGH = 0.2  # s
STATES_EVERY = 150  # scans, as a run of this length keeps them
ASKED_KEPT = 25.0  # kB a scan
COPIED = 1 << 28  # bytes
# What is changed, to what, and how long the whole run may take [s].
JUDGED = (
    ("detection.e_max", 40.0, 0.5),
    ("classification.tree_share", 0.7, 0.5),
    ("tracking.gate", 2.5, 0.5),
    ("detection.radius_max", 0.5, 0.5),
    ("slam.particles", 50, 0.5),
)
_COLUMNS = (
    "change",
    "begun",
    "scans",
    "s",
    "ms a scan",
    "asked s",
    "MB read",
    "limit s",
    "in turn s",
    "reached",
)
LOOKED = (("clustering.eps", 0.2, 1.5), ("filters.voxel_size", 0.02, 2.5))


class Times(NamedTuple):
    """What the first mapping took [s].

    Attributes:
        whole_s: All scans, from their points.
        mapping_s: Median of the part of a scan that needs the scan before.
    """

    whole_s: float
    mapping_s: float

    @property
    def in_turn_s(self) -> float:
        """Lower bound of the time per scan of a rerun, on any number of cores."""
        return self.mapping_s

    def told(self) -> str:
        """Why a rerun cannot be faster."""
        return (
            "Pose and map of a scan follow from the scan before, so scans are mapped in turn: "
            f"{1e3 * self.mapping_s:.3g} ms each (median of the first run), {SCANS * self.in_turn_s:.3g} s "
            f"for {SCANS:,} scans. The preview is what a user sees at once."
        )


def run() -> list[Table]:
    """Preset forest."""
    from pipeline.config import preset
    from pipeline.io.readers import open_source
    from pipeline.remapping import KeptScans

    base = preset("forest")
    source = open_source(URI)
    bandwidth = _bandwidth()
    with closing(KeptScans(most=8 << 30)) as kept:
        held, sample, times, basis = _first_time(source, base, kept)
        size = kept.nbytes / max(len(kept), 1)
        scans = len(kept)
        noted = basis.notes.nbytes
        step_s = times.in_turn_s
        mapped = "mapped from its scans, without reading them"
        rows = [_whole(mapped, scans, times.whole_s, None, 0, bandwidth, scans * step_s)]
        roughly = []
        for name, value, asked in JUDGED:
            tried, words = base.replace({name: value}), f"{name} {_of(base, name)} → {value}"
            begun, tracked = basis.begin(tried, kept.clusters)
            wall = _again(source, tried, kept, scans, None, basis)
            read = noted if tracked else round(kept.nbytes * (1 - begun / scans))
            in_turn = None if tracked else (scans - begun) * step_s
            rows.append(_whole(words, scans, wall, asked, read, bandwidth, in_turn, _from(begun, tracked)))
            roughly.append(_rough(words, basis, kept, tried, None, bandwidth))
        for name, value, asked in LOOKED:
            tried, words = base.replace({name: value}), f"{name} {_of(base, name)} → {value}"
            wall = _again(source, tried, kept, len(held), held)
            roughly.append(_rough(words, basis, kept, tried, (source, sample), bandwidth))
            scaled = asked * len(held) / scans
            points = sum(step.scan.points.nbytes for step in held)
            in_turn = len(held) * step_s
            rows.append(_whole(words, len(held), wall, scaled, points, bandwidth, in_turn))
    return [
        Table(
            f"{URI}, preset forest, 100 particles, warm",
            _COLUMNS,
            tuple(rows),
            (
                f"Kept on disk: {size / 1e3:.1f} kB a scan, {ASKED_KEPT:g} asked: "
                f"{verdict(size <= 1e3 * ASKED_KEPT)}.",
                f"Limit: the bytes to be read by the bandwidth of a copy, {bandwidth / 1e9:.1f} GB/s; "
                "what is asked is for the 6,000 scans of the run; for the last rows, which hold fewer in "
                "memory, in proportion.",
                times.told(),
                f"Kept in memory: {noted / scans / 1e3:.1f} kB a scan of what the stages made of it, and "
                f"{kept.clusters.nbytes / scans / 1e3:.1f} kB of clusters.",
                "Where a scan was taken is found on one core while the one before it is mapped on the other; "
                "what is looked at again is so in a third thread. Trees alone are tracked on one core.",
                "A change of the tracking tracks the trees alone anew; one of a verdict begins at the first "
                "scan whose detections differ, which often is one of the first.",
            ),
        ),
        Table(
            "Rough answer before the exact one",
            ("change", "trees", "s", "asked s", "MB read", "limit s", "reached"),
            tuple(roughly),
            (
                "Kept clusters judged anew at the poses of the map before; other poses it does not know.",
                f"For the last rows {len(sample)} scans of the run, evenly spread, are looked at again on "
                "both cores: what they find of a tree, against what they found, tells of the others.",
            ),
        ),
    ]


def _of(parameters: Parameters, name: str) -> object:
    return parameters.flat()[name]


def _from(begun: int, tracked: bool) -> str:
    if tracked:
        return "trees alone"
    return f"at scan {begun:,}" if begun else "at the first scan"


def _rough(
    words: str,
    basis: Basis,
    kept: KeptScans,
    parameters: Parameters,
    sampled: tuple[Source, Sample] | None,
    bandwidth: float,
) -> tuple[Cell, ...]:
    """The rough answer; once before for the kernels."""
    from app.worker.parallel import looked_at_once
    from pipeline.remapping import rough_trees

    trees, spent, read = None, 0.0, kept.clusters.nbytes
    for _ in range(2):
        looks = None
        start = time.perf_counter()
        if sampled is not None:
            source, sample = sampled
            look = _fresh(source, parameters).segmenter()
            looks = sample.looked(look, len(basis.notes), looked_at_once)
            read = kept.clusters.nbytes + sample.nbytes
        trees = rough_trees(basis, kept.clusters, parameters, looks)
        spent = time.perf_counter() - start
    if trees is None:
        return (words, "none", "", ASKED_ROUGH, "", "", "")
    reached = verdict(spent <= ASKED_ROUGH)
    return (words, len(trees.number), spent, ASKED_ROUGH, read / 1e6, read / bandwidth, reached)


def _fresh(source: Source, parameters: Parameters) -> Mapper:
    from pipeline.mapper import Mapper

    known = source.description
    return Mapper(parameters, sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=0)


def _first_time(
    source: Source, parameters: Parameters, kept: KeptScans
) -> tuple[list[Step], Sample, Times, Basis]:
    """Map the run, keep what it shows and what came of it, and hold its first scans and a sample of all; with
    what the mapping alone takes."""
    from pipeline.odometry.synchroniser import steps
    from pipeline.remapping import Basis, Journal, Sample, look_key

    mapper, key = _fresh(source, parameters), look_key(parameters)
    held: list[Step] = []
    sample = Sample()
    journal, states = Journal(), {}
    mapper.note = lambda noted: journal.note(noted, parameters.slam)
    spent: list[tuple[float, float]] = []
    for step in islice(steps(source.records()), SCANS):
        if step.index % STATES_EVERY == 0:
            states[step.index] = mapper.snapshot()
        start = time.perf_counter()
        looked = mapper.segment(step)
        seen = time.perf_counter()
        mapper.process(step, looked)
        spent.append((seen - start, time.perf_counter() - seen))
        kept.put(step, looked, key)
        sample.offer(step)
        if len(held) < READ_AGAIN:
            held.append(step)
    states[len(kept)] = mapper.snapshot()
    notes, path = journal.first(len(kept)), mapper.path
    times = Times(float(np.sum(spent)), float(np.median(spent, axis=0)[1]))
    return held, sample, times, Basis.of(parameters, notes, states, path, mapper.motion)


def _again(
    source: Source,
    parameters: Parameters,
    kept: KeptScans,
    scans: int,
    held: list[Step] | None,
    basis: Basis | None = None,
) -> float:
    """Seconds that a rerun takes; once before for the kernels, over a few scans."""
    from app.worker.parallel import looked_ahead
    from pipeline.remapping import Rerun

    spent, reread = 0.0, None if held is None else lambda: iter(held)
    for most in (min(scans, 50), scans):
        gc.collect()
        start = time.perf_counter()
        with closing(Rerun(_fresh(source, parameters), kept, reread, basis, looked_ahead)) as rerun:
            for _ in rerun.frames(most):
                pass
            spent = time.perf_counter() - start
    return spent


def _whole(
    change: str,
    scans: int,
    seconds: float,
    asked: float | None,
    read: int,
    bandwidth: float,
    in_turn: float | None,
    begun: str = "at the first scan",
) -> tuple[Cell, ...]:
    limit = read / bandwidth
    reached = "" if asked is None else verdict(seconds <= asked)
    return (
        change,
        begun,
        scans,
        seconds,
        1e3 * seconds / scans,
        "" if asked is None else asked,
        read / 1e6 if read else "",
        limit if read else "",
        "" if in_turn is None else in_turn,
        reached,
    )


def _bandwidth() -> float:
    """Bytes a second that a core reads while it copies: the best of five."""
    source = np.ones(COPIED, np.uint8)
    into = np.empty_like(source)
    best = float("inf")
    for _ in range(5):
        start = time.perf_counter()
        np.copyto(into, source)
        best = min(best, time.perf_counter() - start)
    return COPIED / best
