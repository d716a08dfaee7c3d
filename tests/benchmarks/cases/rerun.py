"""The whole run mapped again after a change of one parameter, and its preview."""

from __future__ import annotations

import gc
import time
from contextlib import closing
from itertools import islice
from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table, verdict

if TYPE_CHECKING:
    from app.worker.remap import RunMap
    from pipeline.config import Parameters
    from pipeline.io.readers.base import Source
    from pipeline.mapper import Mapper
    from pipeline.remapping.preview import KnownMap
    from pipeline.remapping.rerun import ScanCaches
    from pipeline.types.records import Step

NAME = "rerun"
LINE = "The whole run mapped again after a change of one parameter, and its preview"

URI, SCANS = "sim:long", 6000
HELD = 1000  # scans that are held in memory, for changes that need the points again
PREVIEW_S = 0.2  # s asked
CACHED_KB = 25.0  # kB a scan asked
# Changes that use cached scans, and those that segment the scans again.
CACHED = (
    ("detection.e_max", 40.0),
    ("classification.tree_share", 0.7),
    ("tracking.proximity_radius", 0.3),
    ("slam.particles", 50),
)
SEGMENTED = (("clustering.eps", 0.2), ("filters.voxel_size", 0.02))


def run() -> list[Table]:
    """Preset forest."""
    from pipeline.config import preset
    from pipeline.io.readers import open_source
    from pipeline.remapping.rerun import ScanCaches

    base, source = preset("forest"), open_source(URI)
    with closing(ScanCaches(most=8 << 30)) as caches:
        held, known_run, known, first_s = _first_run(source, base, caches)
        scans = len(caches.of(base))
        size_kb = 1e-3 * caches.of(base).nbytes / scans
        reruns = [_row("first run, without reading", scans, first_s)]
        previews = []
        for name, value in CACHED:
            tried, words = base.replace({name: value}), f"{name} → {value}"
            reruns.append(_row(words, scans, _rerun_s(source, tried, caches, scans, None, known_run)))
            previews.append(_preview(words, known, tried, source, held))
        for name, value in SEGMENTED:
            tried, words = base.replace({name: value}), f"{name} → {value}"
            seconds = _rerun_s(source, tried, caches, len(held), held)
            reruns.append(_row(words, len(held), seconds))
            previews.append(_preview(words, known, tried, source, held))
    return [
        Table(
            f"{URI}, preset forest, warm",
            ("change", "scans", "s", "ms a scan"),
            tuple(reruns),
            (
                f"Scan cache: {size_kb:.1f} kB a scan; {CACHED_KB:g} asked: {verdict(size_kb <= CACHED_KB)}.",
                "A rerun is the main loop over cached scans; the last rows segment them first. Votes and "
                "tracking make only the trees again.",
            ),
        ),
        Table(
            "Preview before the rerun",
            ("change", "trees", "s", "asked s", "reached"),
            tuple(previews),
            ("For the last rows a sample of scans is segmented again.",),
        ),
    ]


def _row(words: str, scans: int, seconds: float) -> tuple[Cell, ...]:
    return (words, scans, seconds, 1e3 * seconds / scans)


def _mapper(source: Source, parameters: Parameters) -> Mapper:
    from pipeline.mapper import Mapper

    known = source.description
    return Mapper(parameters, sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=0)


def _first_run(
    source: Source, parameters: Parameters, caches: ScanCaches
) -> tuple[list[Step], RunMap, KnownMap, float]:
    """Map the run and cache its scans; returns its first scans, the run with its records, the map, and the
    seconds taken without records."""
    from app.worker.remap import RunMap
    from pipeline.odometry.synchroniser import steps
    from pipeline.remapping.preview import ClusterTable, KnownMap

    mapper, cache, clusters = _mapper(source, parameters), caches.of(parameters), ClusterTable()
    held: list[Step] = []
    run = RunMap(mapper, parameters, lambda: 0)
    spent, columns = 0.0, None
    for step in islice(steps(source.records()), SCANS):
        start = time.perf_counter()
        scan = mapper.segment(step)
        frame = mapper.process(step, scan)
        spent += time.perf_counter() - start
        run.add(frame, scan.free, {})
        cache.put(step, scan)
        clusters.record(frame)
        columns = frame.columns
        if len(held) < HELD:
            held.append(step)
    run.before = mapper.snapshot()
    return held, run, KnownMap(parameters, clusters, mapper.path, columns), spent


def _rerun_s(
    source: Source,
    parameters: Parameters,
    caches: ScanCaches,
    scans: int,
    held: list[Step] | None,
    known: RunMap | None = None,
) -> float:
    """Seconds of a rerun, of the trees only where that suffices; a short one before compiles the kernels."""
    from app.worker.remap import segment_ahead
    from pipeline.remapping.rerun import Rerun, ScanCaches

    spent, reread = 0.0, None if held is None else lambda index: iter(held[index:])
    for most in (min(scans, 50), scans):
        gc.collect()
        with closing(ScanCaches()) as fresh:
            cache = (caches if held is None else fresh).of(parameters)
            start = time.perf_counter()
            mapper = _mapper(source, parameters)
            trees = None if known is None else known.tree_rerun(mapper)
            with closing(trees or Rerun(mapper, cache, reread, segment_ahead)) as rerun:
                for _ in range(most):
                    rerun.map_next()
                spent = time.perf_counter() - start
    return spent


def _preview(
    words: str, known: KnownMap, parameters: Parameters, source: Source, held: list[Step]
) -> tuple[Cell, ...]:
    """The preview; one before compiles the kernels."""
    from pipeline.remapping.preview import preview_trees, sample_scans

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
