"""Starts without a pose in stored maps: Wild-Places in each map, simulated stands, and other places."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tests.benchmarks.seeds import chosen_seeds
from tests.benchmarks.table import Cell, Table, verdict

if TYPE_CHECKING:
    from tests.benchmarks.localise.drives import Drive, Reference
    from tests.benchmarks.localise.starts import Start

NAME = "localise"
LINE = "Localisation in a stored map without a start pose: found, wrong fixes, errors, time of a search"
STARTS = 200  # of each pair; --starts N
SEEDS = range(11, 13)  # of simulated stands; 1 to 3 were used to choose
SIDE, LANE = 140.0, 16.0  # m; a stand, and the distance of the lanes of its mapped drive
STANDS = {
    "natural, 500 stems/ha": {"density": 0.05},
    "sparse, 150 stems/ha": {"density": 0.015},
    "planted in rows": {"density": 0.1, "rows": True},
}
FELLED = 0.1
MAP_SEED = 1
RECALL = "Wild_V03"  # the recording that TreeLoc++ reports
RECALL_NOTE = (
    "Frames within 5 m of the path of the map; found: the best pose is within 5 m. Needed: 0.95. TreeLoc++ "
    "reports 0.951 for revisits within V03; here the map is that of another visit."
)
#: What the issue asks for: found [%], wrong fixes, position [m], heading [degrees], search [ms].
NEEDED = (95.0, 0, 0.3, 1.0, 50.0)


def run() -> list[Table]:
    """A table with simulated stands, and one with the recorded drives if they are there."""
    starts = int(os.environ.get("STEMMAP_BENCH_STARTS", STARTS))
    root = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
    tables = _recorded(root, starts) if (root / "wild_places").is_dir() else []
    return [*tables, _simulated(starts)]


def _simulated(starts: int) -> Table:
    """Drives through the same stand on other ways, with one tree of ten felled, in its map and in the map of
    another stand of the same kind."""
    from tests.benchmarks.localise.drives import stand, stand_drive, sweep, wander
    from tests.benchmarks.localise.starts import COLUMNS, row_of, run_start

    rows: list[tuple[Cell, ...]] = []
    everything: list[Start] = []
    for kind, how in STANDS.items():
        results: list[list[Start]] = [[], []]
        for seed in chosen_seeds(SEEDS):
            here, other = stand(seed, SIDE, **how), stand(seed + 1000, SIDE, **how)  # type: ignore[arg-type]
            maps = [
                _kept(f"{kind}-{seed}", stand_drive(kind, *here, sweep(SIDE, LANE), seed)),
                _elsewhere(
                    _kept(f"{kind}-{seed + 1000}", stand_drive(kind, *other, sweep(SIDE, LANE), seed))
                ),
            ]
            for k in range(-(-starts // len(chosen_seeds(SEEDS)))):
                way = wander(SIDE, 85.0, np.random.default_rng([seed, k]))
                drive = stand_drive(kind, *here, way, 1000 * seed + k, felled=FELLED)
                for result, start in zip(results, run_start(drive, 0, k, maps), strict=True):
                    result.append(start)
        for name, result in zip(("its own map", "map of another stand"), results, strict=True):
            rows.append((kind, name, *row_of(result)))
            print(*rows[-1], file=sys.stderr, flush=True)
        everything += [start for result in results for start in result]
    return Table("Simulated stands", ("stand", "in", *COLUMNS), tuple(rows), _notes(everything))


def _recorded(root: Path, starts: int) -> list[Table]:
    """Each drive of Wild-Places in each map, and in the map of another forest."""
    from tests.benchmarks.localise.drives import recorded_drive
    from tests.benchmarks.localise.starts import COLUMNS, LONGER, WITHIN, frames_found, row_of, run_start

    drives = [recorded_drive(file.stem, file) for file in sorted((root / "wild_places").glob("*.npz"))]
    maps = [_kept(drive.name, drive) for drive in drives]
    evo = root / "oxford_evo" / "Evo.npz"
    others = [_elsewhere(_kept("Evo", recorded_drive("Evo", evo)))] if evo.is_file() else []
    rows: list[tuple[Cell, ...]] = []
    everything: list[Start] = []
    for drive in drives:
        stored_drives = [None if other is drive else other for other in drives] + [None] * len(others)
        rng = np.random.default_rng(len(drive.poses))
        last = int(np.searchsorted(drive.driven, drive.driven[-1] - WITHIN - LONGER))
        results: list[list[Start]] = [[] for _ in [*maps, *others]]
        for k, begin in enumerate(rng.integers(0, last, starts).tolist()):
            for result, start in zip(
                results, run_start(drive, begin, 1000 + k, [*maps, *others], stored_drives), strict=True
            ):
                result.append(start)
        for stored, result in zip([*maps, *others], results, strict=True):
            rows.append((drive.name, stored.name, *row_of(result)))
            print(*rows[-1], file=sys.stderr, flush=True)
        everything += [start for result in results for start in result]
    sizes = [
        (m.name, len(m.stored), size := len(m.stored.as_bytes()) / 1e3, 1e3 * size / float(d.driven[-1]))
        for m, d in zip(maps, drives, strict=True)
    ]
    frames = list[tuple[Cell, ...]]()
    for drive in drives:
        if drive.name == RECALL:
            for stored in maps:
                if stored.name != drive.name:
                    found, of = frames_found(drive, stored)
                    frames.append((drive.name, stored.name, found, of, found / max(of, 1)))
    note = "Needed: 100 kB per kilometre. The files have no terrain, because these recordings have none."
    offset = (
        "The true poses of the drives share a frame only to 0.5 m, with errors that differ by 0.1 to 0.2 m "
        "from place to place: the shift between the stems of two drives at equal true poses is measured in "
        "the frames alone, at each place, and taken off."
    )
    return [
        Table("Wild-Places", ("drive", "in", *COLUMNS), tuple(rows), (*_notes(everything), offset)),
        Table("Single frames", ("frames", "in", "found", "of", "recall@1"), tuple(frames), (RECALL_NOTE,)),
        Table("Size of a stored map", ("map", "stems", "kB", "kB/km"), tuple(sizes), (note,)),
    ]


def _notes(starts: list[Start]) -> tuple[str, ...]:
    """Return the figures of all starts beside those that are needed."""
    from tests.benchmarks.localise.starts import row_of

    total = row_of(starts)
    found, wrong, xy, yaw, ms = total[2], total[3], total[5] / 100.0, total[6], total[8]
    figures = (found, wrong, xy, yaw, ms)
    reached = [found >= NEEDED[0], *(a <= b for a, b in zip(figures[1:], NEEDED[1:], strict=True))]
    names = ("found [%]", "wrong fixes", "position [m]", "heading [deg]", "search, median [ms]")
    return tuple(
        f"All {len(starts)} starts, {name}: {figure:.3g}, needed {need:g}: {verdict(is_reached)}."
        for name, figure, need, is_reached in zip(names, figures, NEEDED, reached, strict=True)
    )


def _kept(name: str, drive: Drive) -> Reference:
    """Return the map of a drive. With STEMMAP_BENCH_MAPS it is kept in that folder and read again there."""
    from tests.benchmarks.localise.drives import Reference

    folder = os.environ.get("STEMMAP_BENCH_MAPS")
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(folder or temporary) / f"{re.sub(r'[^-A-Za-z0-9_]+', '_', name)}.npz"
        if not file.is_file():
            print(f"mapping {name}", file=sys.stderr, flush=True)
            drive.map(MAP_SEED).save(file)
        return Reference.load(drive.name, file)


def _elsewhere(reference: Reference) -> Reference:
    """Return a map whose place no drive reaches, so that each fix in it is wrong."""
    from dataclasses import replace

    return replace(reference, truth=reference.truth + 1e6)
