"""DBSCAN by our grid, scikit-learn and Open3D."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table, ratio
from tests.benchmarks.timing import in_turns, middle

if TYPE_CHECKING:
    from pipeline.records import Float32

NAME = "dbscan"
LINE = "DBSCAN by our grid, scikit-learn and Open3D on the same points"

EPS, MIN_POINTS = 0.25, 20  # of the paper
SIZES = ((1_000, 11), (10_000, 5), (30_000, 3))  # points and rounds
POINTS_A_TRUNK = 160
NOISE_PART = 0.2


def run() -> list[Table]:
    """Three sizes in three dimensions."""
    rows = tuple(row(size, rounds) for size, rounds in SIZES)
    columns = ("points", "clusters", "noise", "grid ms", "scikit-learn ms", "Open3D ms", "ratios", "agree")
    return [
        Table(
            f"DBSCAN in 3D, eps {EPS:g} m, {MIN_POINTS} points of a core",
            columns,
            rows,
            (
                "Half cylinders of 160 points and a fifth of scattered points, at the same density for every size. "
                "Ratios: scikit-learn and Open3D over ours. Agree: same number of clusters and same noise.",
            ),
        )
    ]


def row(size: int, rounds: int) -> tuple[Cell, ...]:
    """Medians at one size."""
    from pipeline.clustering import ENGINES

    points = scene(size)
    sides: dict[str, Callable[[], object]] = {
        name: partial(engine, points, EPS, MIN_POINTS) for name, engine in ENGINES.items()
    }
    times = {name: middle(ms) for name, ms in in_turns(sides, rounds).items()}
    labels = [engine(points, EPS, MIN_POINTS).label for engine in ENGINES.values()]
    first = labels[0]
    agree = all(bool(((a < 0) == (first < 0)).all()) and a.max() == first.max() for a in labels)
    return (
        size,
        int(first.max()) + 1,
        int((first < 0).sum()),
        times["grid"],
        times["sklearn"],
        times["open3d"],
        f"{ratio(times['sklearn'], times['grid'])}, {ratio(times['open3d'], times['grid'])}",
        "yes" if agree else "NO",
    )


def scene(size: int) -> Float32:
    """Trunks as a LiDAR sees them, and noise; float32, shape (size, 3) [m], shuffled."""
    import numpy as np

    random = np.random.default_rng(size)
    noise = int(NOISE_PART * size)
    side = np.sqrt(size) * 0.6
    trunks = max(1, (size - noise) // POINTS_A_TRUNK)
    place = random.uniform(0.0, side, (trunks, 2))
    trunk = np.arange(size - noise) % trunks
    angle = random.uniform(0.0, np.pi, size - noise)
    circle = 0.15 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.empty((size, 3))
    points[: size - noise, :2] = place[trunk] + circle + random.normal(0.0, 0.02, circle.shape)
    points[size - noise :, :2] = random.uniform(0.0, side, (noise, 2))
    points[:, 2] = random.uniform(0.0, 1.5, size)
    return random.permutation(points).astype(np.float32)
