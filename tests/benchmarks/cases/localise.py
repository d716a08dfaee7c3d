"""Starts without a pose in stored maps: Wild-Places in each map, simulated stands, and other places.

With STEMMAP_BENCH_MAPS=DIR, the maps are written to a folder and read again by the next run. Remove them
after a change of the mapping.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tests.benchmarks.process import on_cores
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
EVO = Path("oxford_evo", "Evo.npz")  # another forest
RECALL = "Wild_V03"  # the recording that TreeLoc++ reports
RECALL_NOTE = (
    "Frames within 5 m of the path of the map; found: the best pose is within 5 m. Needed: 0.95. TreeLoc++ "
    "reports 0.951 for revisits within V03; here the map is that of another visit."
)
#: Requirements of the issue: found [%], wrong fixes, position [m], heading [degrees], search [ms].
NEEDED = (95.0, 0, 0.3, 1.0, 50.0)


def run() -> list[Table]:
    """A table with simulated stands, and one with the recorded drives if they exist."""
    starts = int(os.environ.get("STEMMAP_BENCH_STARTS", STARTS))
    root = Path(os.environ.get("STEMMAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(os.environ.get("STEMMAP_BENCH_MAPS", temporary))
        tables = _recorded(root, starts, folder) if (root / "wild_places").is_dir() else []
        return [*tables, _simulated(starts, folder)]


def _start_in_stand(task: tuple[str, int, int, Path]) -> list[Start]:
    """The results of one start by kind, seed, number and folder, in its own map and another."""
    from tests.benchmarks.localise.drives import stand, stand_drive, wander
    from tests.benchmarks.localise.starts import run_start

    kind, seed, k, folder = task
    way = wander(SIDE, 85.0, np.random.default_rng([seed, k]))
    here = stand(seed, SIDE, **STANDS[kind])  # type: ignore[arg-type]
    drive = stand_drive(kind, *here, way, 1000 * seed + k, felled=FELLED)
    return run_start(drive, 0, k, _maps_of_stand(kind, seed, folder))


@cache
def _maps_of_stand(kind: str, seed: int, folder: Path) -> tuple[Reference, Reference]:
    """The map of a stand, and that of another one of its kind."""
    from tests.benchmarks.localise.drives import stand, stand_drive, sweep

    here, other = (stand(s, SIDE, **STANDS[kind]) for s in (seed, seed + 1000))  # type: ignore[arg-type]
    own = _kept(f"{kind}-{seed}", stand_drive(kind, *here, sweep(SIDE, LANE), seed), folder)
    another = _kept(f"{kind}-{seed + 1000}", stand_drive(kind, *other, sweep(SIDE, LANE), seed), folder)
    return own, _elsewhere(another)


def _simulated(starts: int, folder: Path) -> Table:
    """Drives through the same stand on other paths, with one of ten trees felled, in its map and in the map
    of another stand of the same kind."""
    from tests.benchmarks.localise.starts import COLUMNS, row_of

    seeds = chosen_seeds(SEEDS)
    stands = [(kind, seed) for kind in STANDS for seed in seeds]
    list(on_cores(_map_stand, [(*stand, folder) for stand in stands]))
    tasks = [(*stand, k, folder) for stand in stands for k in range(-(-starts // len(seeds)))]
    results = dict(on_cores(_start_in_stand, tasks))
    rows: list[tuple[Cell, ...]] = []
    everything: list[Start] = []
    for kind in STANDS:
        both = zip(*(results[task] for task in tasks if task[0] == kind), strict=True)
        for name, of in zip(("its own map", "map of another stand"), both, strict=True):
            rows.append((kind, name, *row_of(of)))
            everything += of
    return Table("Simulated stands", ("stand", "in", *COLUMNS), tuple(rows), _notes(everything))


def _map_stand(task: tuple[str, int, Path]) -> None:
    _maps_of_stand(*task)


@cache
def _recordings(root: Path, folder: Path) -> tuple[list[Drive], list[Reference]]:
    """The drives of Wild-Places, and their maps followed by that of another forest."""
    from tests.benchmarks.localise.drives import recorded_drive

    drives = [recorded_drive(file.stem, file) for file in _recording_files(root)]
    maps = [_kept(drive.name, drive, folder) for drive in drives]
    if (evo := root / EVO).is_file():
        maps.append(_elsewhere(_kept("Evo", recorded_drive("Evo", evo), folder)))
    return drives, maps


def _recording_files(root: Path) -> list[Path]:
    return sorted((root / "wild_places").glob("*.npz"))


def _map_recording(task: tuple[Path, Path]) -> None:
    """Map a recording into a folder."""
    from tests.benchmarks.localise.drives import recorded_drive

    file, folder = task
    _kept(file.stem, recorded_drive(file.stem, file), folder)


def _start_of(task: tuple[Path, Path, int, int, int]) -> list[Start]:
    """The results in all maps of one start, by root, folder, number of the drive, first frame and seed."""
    from tests.benchmarks.localise.starts import run_start

    root, folder, number, begin, seed = task
    drives, maps = _recordings(root, folder)
    stored_drives = [None if k == number or k >= len(drives) else drives[k] for k in range(len(maps))]
    return run_start(drives[number], begin, seed, maps, stored_drives)


def _frames_of(task: tuple[Path, Path, int, int]) -> tuple[int, int]:
    """`frames_found` by root, folder, number of the drive and of the map."""
    from tests.benchmarks.localise.starts import frames_found

    root, folder, number, stored = task
    drives, maps = _recordings(root, folder)
    return frames_found(drives[number], maps[stored])


def _recorded(root: Path, starts: int, folder: Path) -> list[Table]:
    """Each drive of Wild-Places in each map, and in the map of another forest."""
    from tests.benchmarks.localise.starts import COLUMNS, LONGER, WITHIN, row_of

    evo = root / EVO
    files = [*_recording_files(root), *([evo] if evo.is_file() else [])]
    for (file, _), _ in on_cores(_map_recording, [(file, folder) for file in files]):
        print(f"mapped {file.stem}", file=sys.stderr, flush=True)
    drives, maps = _recordings(root, folder)
    tasks = list[tuple[Path, Path, int, int, int]]()
    for number, drive in enumerate(drives):
        rng = np.random.default_rng(len(drive.poses))
        last = int(np.searchsorted(drive.driven, drive.driven[-1] - WITHIN - LONGER))
        begins = rng.integers(0, last, starts).tolist()
        tasks += [(root, folder, number, begin, 1000 + k) for k, begin in enumerate(begins)]
    results: dict[tuple[Path, Path, int, int, int], list[Start]] = {}
    for task, result in on_cores(_start_of, tasks):
        results[task] = result
        if len(results) % 50 == 0:
            print(f"{len(results)} of {len(tasks)} starts", file=sys.stderr, flush=True)
    rows: list[tuple[Cell, ...]] = []
    everything: list[Start] = []
    for number, drive in enumerate(drives):
        for stored, of in zip(
            maps, zip(*(results[t] for t in tasks if t[2] == number), strict=True), strict=True
        ):
            rows.append((drive.name, stored.name, *row_of(of)))
            everything += of
    sizes = [
        (m.name, len(m.stored), size := len(m.stored.as_bytes()) / 1e3, 1e3 * size / float(d.driven[-1]))
        for m, d in zip(maps, drives, strict=False)
    ]
    recall = [k for k, drive in enumerate(drives) if drive.name == RECALL]
    pairs = [(root, folder, k, m) for k in recall for m in range(len(drives)) if m != k]
    found = dict(on_cores(_frames_of, pairs))
    frames = tuple(
        (RECALL, maps[pair[3]].name, *found[pair], found[pair][0] / max(found[pair][1], 1)) for pair in pairs
    )
    note = "Needed: 100 kB per kilometre. The files have no terrain, because these recordings have none."
    offset = (
        "The true poses of the drives share a frame only to 0.5 m, with errors that differ by 0.1 to 0.2 m "
        "from place to place: the shift between the stems of two drives at equal true poses is measured in "
        "the frames alone, at each place, and taken off."
    )
    return [
        Table("Wild-Places", ("drive", "in", *COLUMNS), tuple(rows), (*_notes(everything), offset)),
        Table("Single frames", ("frames", "in", "found", "of", "recall@1"), frames, (RECALL_NOTE,)),
        Table("Size of a stored map", ("map", "stems", "kB", "kB/km"), tuple(sizes), (note,)),
    ]


def _notes(starts: list[Start]) -> tuple[str, ...]:
    """Return the figures of all starts with the required ones."""
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


def _kept(name: str, drive: Drive, folder: Path) -> Reference:
    """Return the map of a drive, which is stored in a folder and read from there the next time."""
    from tests.benchmarks.localise.drives import Reference

    file = folder / f"{re.sub(r'[^-A-Za-z0-9_]+', '_', name)}.npz"
    if not file.is_file():
        drive.map(MAP_SEED).save(file)
    return Reference.load(drive.name, file)


def _elsewhere(reference: Reference) -> Reference:
    """Return a map of a place that no drive reaches, so that each fix in it is wrong."""
    from dataclasses import replace

    return replace(reference, truth=reference.truth + 1e6)
