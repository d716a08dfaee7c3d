"""DBSCAN by our grid, scikit-learn, Open3D and the package `dbscan` of PyPI."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table, ratio
from tests.benchmarks.timing import in_turns, middle

if TYPE_CHECKING:
    from pipeline.types.records import Float32, Int32

NAME = "dbscan"
LINE = "DBSCAN by our grid, scikit-learn, Open3D and PyPI dbscan on the same points"

SIZES = ((1_000, 11), (10_000, 5), (30_000, 2))  # points and rounds
SETTINGS = ((3, 0.25, 20), (2, 0.15, 8))  # dimensions, eps [m], points of a core: the paper's and forest's
BOX = (10.0, 20.0, 0.5)  # m, of the paper
TRUNKS = 25
NOISE_PART = 0.3
#: Real scans by name: a park, and a street of 64 rings.
REAL = {"park": "park_trunks/00", "KITTI": "semantickitti/000000.bin"}
REAL_ROUNDS = 5
DATA = Path(os.environ.get("STEMMAP_DATA", "../shared/data"))
_COLUMNS = (
    "points", "clusters", "noise", "grid ms", "scikit-learn ms", "Open3D ms", "PyPI dbscan ms", "ratios",
    "agree", "PyPI other",
)  # fmt: skip
_RATIOS = (
    "Ratios: scikit-learn, Open3D and PyPI dbscan over ours, one thread each. Agree: the first three have "
    "the same number of clusters and the same noise. PyPI other: points that "
    "are noise for PyPI dbscan only, or for the others only."
)
_NOTE = (
    f"{TRUNKS} half cylinders and scattered points ({NOISE_PART:.0%}) in the paper's box of 10 x 20 x 0.5 m, "
    f"as one scan or many pooled ones give them. {_RATIOS}"
)


def run() -> list[Table]:
    """Three sizes with the paper's settings and with those of forest."""
    return [
        Table(
            f"DBSCAN in {dimensions}D, eps {eps:g} m, {min_points} points of a core",
            _COLUMNS,
            tuple(row(scene(size)[:, :dimensions], rounds, eps, min_points) for size, rounds in SIZES),
            (_NOTE,),
        )
        for dimensions, eps, min_points in SETTINGS
    ] + [_real_scans()]


def _real_scans() -> Table:
    """The points of real scans that `forest` clusters, with both settings."""
    from pipeline.config import preset
    from pipeline.front_end import segment
    from pipeline.io.readers import open_source
    from pipeline.odometry.synchroniser import steps

    rows: list[tuple[Cell, ...]] = []
    for name, place in REAL.items():
        if not (DATA / place).exists():
            continue
        source = open_source(str(DATA / place))
        step = next(iter(steps(source.records())))
        about = source.description
        points = segment(step, about.sensor, about.T_base_lidar, preset("forest")).filtered
        for dimensions, eps, min_points in SETTINGS:
            values = row(points[:, :dimensions], REAL_ROUNDS, eps, min_points)
            rows.append((f"{name}, {dimensions}D", *values))
    return Table("DBSCAN of real scans, settings as above", ("scan", *_COLUMNS), tuple(rows), (_RATIOS,))


def row(given: Float32, rounds: int, eps: float, min_points: int) -> tuple[Cell, ...]:
    """Medians for some points, float32, shape (N, 2) or (N, 3) [m]."""
    import numpy as np

    from pipeline.detection.clustering import ENGINES

    points = np.ascontiguousarray(given)
    sides: dict[str, Callable[[], Int32]] = {
        name: partial(engine, points, eps, min_points) for name, engine in ENGINES.items()
    }
    labels = [work() for work in sides.values()]
    first = labels[0]
    sides["pypi"] = partial(_pypi, points, eps, min_points)
    other = int(np.count_nonzero((sides["pypi"]() < 0) != (first < 0)))
    agree = all(bool(((a < 0) == (first < 0)).all()) and a.max() == first.max() for a in labels)
    times = {name: middle(ms) for name, ms in in_turns(sides, rounds, warm=False).items()}
    return (
        len(points),
        int(first.max()) + 1,
        int((first < 0).sum()),
        times["grid"],
        times["sklearn"],
        times["open3d"],
        times["pypi"],
        ", ".join(ratio(times[name], times["grid"]) for name in ("sklearn", "open3d", "pypi")),
        "yes" if agree else "NO",
        other,
    )


def _pypi(points: Float32, eps: float, min_points: int) -> Int32:
    """Labels by the package `dbscan`, which uses Gunawan's and Wang's algorithms, with one thread."""
    os.environ["PARLAY_NUM_THREADS"] = "1"  # read when the package is loaded
    import numpy as np
    from dbscan import DBSCAN

    found: Int32 = DBSCAN(points.astype(np.float64), eps=eps, min_samples=min_points)[0].astype(np.int32)
    return found


def scene(size: int) -> Float32:
    """Trunks as a LiDAR sees them, and noise; float32, shape (size, 3) [m], shuffled."""
    import numpy as np

    random = np.random.default_rng(size)
    noise = int(NOISE_PART * size)
    place = random.uniform((0.0, 0.0), BOX[:2], (TRUNKS, 2))
    angle = random.uniform(0.0, np.pi, size - noise)
    circle = 0.15 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = random.uniform((0.0, 0.0, 0.0), BOX, (size, 3))
    points[noise:, :2] = place[np.arange(size - noise) % TRUNKS] + circle
    points[noise:, :2] += random.normal(0.0, 0.02, circle.shape)
    return random.permutation(points).astype(np.float32)
