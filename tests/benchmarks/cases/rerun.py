"""The whole run mapped again after a change of one parameter, and its preview."""

from __future__ import annotations

import os
import time
from contextlib import ExitStack, closing
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks.process import CLONE, ROOT, Side
from tests.benchmarks.table import Cell, Table, verdict

if TYPE_CHECKING:
    from pipeline.config import Parameters
    from pipeline.io.readers.base import Source
    from pipeline.mapper import Mapper
    from pipeline.remapping.preview import KnownMap
    from pipeline.remapping.rerun import ScanCaches
    from pipeline.types.records import Step

NAME = "rerun"
LINE = "The whole run mapped again after a change of one parameter, and its preview"

URI = "sim:long"
SCANS = int(os.environ.get("STEMMAP_BENCH_SCANS", "6000"))
PREVIEWED = 1000  # scans of a run with previews; the first of them are held in memory
PREVIEW_S = 0.2  # s asked
CACHED_KB = 25.0  # kB a scan asked
BEFORE = "5287824d"  # commit of the version before
# Change, seconds for 6,000 scans on two quiet cores before, and needed there.
CHANGES: tuple[tuple[str, float, float, float], ...] = (
    ("classification.tree_share", 0.7, 27.0, 1.0),
    ("tracking.proximity_radius", 0.3, 27.0, 1.0),
    ("detection.e_max", 40.0, 27.0, 6.0),
    ("slam.particles", 50, 25.0, 6.0),
    ("clustering.eps", 0.2, 34.0, 9.0),
    ("filters.voxel_size", 0.02, 35.0, 10.0),
)


def run() -> list[Table]:
    """Preset forest."""
    return [_reruns(), _previews()]


def _reruns() -> Table:
    """Each change once, in turns with another clone if one is named."""
    clone = os.environ.get(CLONE)
    clones = {"before": Path(clone)} if clone else {}
    rows: list[tuple[Cell, ...]] = []
    with ExitStack() as stack:
        sides = {
            name: Side("tests.benchmarks.remapping_run", URI, str(SCANS), clone=root)
            for name, root in {**clones, "now": ROOT}.items()
        }
        for side in sides.values():
            stack.callback(side.end)
        for name, value, before_s, needed_s in CHANGES:
            told = {k: side.ask({"change": [name, value]}) for k, side in sides.items()}
            now, needed = told["now"], needed_s / before_s
            row: tuple[Cell, ...] = (
                f"{name} → {value}",
                now["trees"],
                now["s"],
                now["cpu_s"],
                1e3 * now["cpu_s"] / SCANS,
            )
            if clone:
                before = told["before"]
                share = now["cpu_s"] / before["cpu_s"]
                figures = (before["s"], before["cpu_s"], now["s"] / before["s"], share)
                row = (*row, *figures, needed, verdict(share <= needed))
            rows.append(row)
    columns: tuple[str, ...] = ("change", "trees", "s", "CPU s", "CPU ms a scan")
    if clone:
        columns += ("before s", "before CPU s", "ratio", "ratio of CPU", "needed", "reached")
    return Table(
        f"{URI}, {SCANS} scans, preset forest, warm, from a change to the new map",
        columns,
        tuple(rows),
        (
            "With preview, stored frames and states, as in the program. eps and voxel_size segment all scans "
            "again, on a second thread.",
            f"Needed: ratio to commit {BEFORE}, whose clone is named by {CLONE}; both are measured in turns.",
        ),
    )


def _previews() -> Table:
    """Each change of votes, verdicts and clusters."""
    from pipeline.config import preset
    from pipeline.io.readers import open_source
    from pipeline.remapping.rerun import ScanCaches

    base, source = preset("forest"), open_source(URI)
    with closing(ScanCaches()) as caches:
        held, known = _first_run(source, base, caches)
        cache = caches.of(base)
        size_kb = 1e-3 * cache.nbytes / len(cache)
    return Table(
        f"Preview before the rerun, {PREVIEWED} scans",
        ("change", "trees", "s", "asked s", "reached"),
        tuple(_preview(name, value, known, source, held) for name, value, *_ in CHANGES),
        (
            "For the last rows a sample of scans is segmented again.",
            f"Scan cache: {size_kb:.1f} kB a scan; {CACHED_KB:g} asked: {verdict(size_kb <= CACHED_KB)}.",
        ),
    )


def _mapper(source: Source, parameters: Parameters) -> Mapper:
    from pipeline.mapper import Mapper

    known = source.description
    return Mapper(parameters, sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=0)


def _first_run(source: Source, parameters: Parameters, caches: ScanCaches) -> tuple[list[Step], KnownMap]:
    """Map a run and cache its scans; returns its scans and the map."""
    from pipeline.odometry.synchroniser import steps
    from pipeline.remapping.preview import ClusterTable, KnownMap

    mapper, cache, clusters = _mapper(source, parameters), caches.of(parameters), ClusterTable()
    held: list[Step] = []
    columns = None
    for step in islice(steps(source.records()), PREVIEWED):
        scan = mapper.segment(step)
        frame = mapper.process(step, scan)
        cache.put(step, scan)
        clusters.record(frame)
        columns = frame.columns
        held.append(step)
    return held, KnownMap(parameters, clusters, mapper.path, columns)


def _preview(name: str, value: float, known: KnownMap, source: Source, held: list[Step]) -> tuple[Cell, ...]:
    """Measure the preview; an earlier one compiles the kernels."""
    from pipeline.remapping.preview import preview_trees, sample_scans

    parameters, words = known.parameters.replace({name: value}), f"{name} → {value}"
    segment = _mapper(source, parameters).segmenter()
    numbers = sample_scans(len(held), held[0].scan.points.nbytes)
    trees, spent = None, 0.0
    for _ in range(2):
        start = time.perf_counter()
        trees = preview_trees(known, parameters, {n: segment(held[n]) for n in numbers})
        spent = time.perf_counter() - start
    if trees is None:
        return (words, "none", "", PREVIEW_S, "")
    return (words, len(trees.number), spent, PREVIEW_S, verdict(spent <= PREVIEW_S))
