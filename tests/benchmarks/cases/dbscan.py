"""DBSCAN by our grid, scikit-learn and Open3D."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from tests.benchmarks.table import Cell, Table, ratio
from tests.benchmarks.timing import in_turns, middle

if TYPE_CHECKING:
    from pipeline.types.records import Float32, Int32

NAME = "dbscan"
LINE = "DBSCAN by our grid, scikit-learn and Open3D on the same points"

SIZES = ((1_000, 11), (10_000, 5), (30_000, 2))  # points and rounds
SETTINGS = ((3, 0.25, 20), (2, 0.15, 8))  # dimensions, eps [m], points of a core: the paper's and forest's
BOX = (10.0, 20.0, 0.5)  # m, of the paper
TRUNKS = 25
NOISE_PART = 0.3
_COLUMNS = ("points", "clusters", "noise", "grid ms", "scikit-learn ms", "Open3D ms", "ratios", "agree")
_NOTE = (
    f"{TRUNKS} half cylinders and scattered points ({NOISE_PART:.0%}) in the paper's box of 10 x 20 x 0.5 m, "
    "as one scan or many pooled ones give them. Ratios: scikit-learn and Open3D over ours. "
    "Agree: same number of clusters and same noise."
)


def run() -> list[Table]:
    """Three sizes with the paper's settings and with those of forest."""
    return [
        Table(
            f"DBSCAN in {dimensions}D, eps {eps:g} m, {min_points} points of a core",
            _COLUMNS,
            tuple(row(size, rounds, dimensions, eps, min_points) for size, rounds in SIZES),
            (_NOTE,),
        )
        for dimensions, eps, min_points in SETTINGS
    ]


def row(size: int, rounds: int, dimensions: int, eps: float, min_points: int) -> tuple[Cell, ...]:
    """Medians at one size."""
    import numpy as np

    from pipeline.detection.clustering import ENGINES

    points = np.ascontiguousarray(scene(size)[:, :dimensions])
    sides: dict[str, Callable[[], Int32]] = {
        name: partial(engine, points, eps, min_points) for name, engine in ENGINES.items()
    }
    labels = [work() for work in sides.values()]
    first = labels[0]
    agree = all(bool(((a < 0) == (first < 0)).all()) and a.max() == first.max() for a in labels)
    times = {name: middle(ms) for name, ms in in_turns(sides, rounds, warm=False).items()}
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
    place = random.uniform((0.0, 0.0), BOX[:2], (TRUNKS, 2))
    angle = random.uniform(0.0, np.pi, size - noise)
    circle = 0.15 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = random.uniform((0.0, 0.0, 0.0), BOX, (size, 3))
    points[noise:, :2] = place[np.arange(size - noise) % TRUNKS] + circle
    points[noise:, :2] += random.normal(0.0, 0.02, circle.shape)
    return random.permutation(points).astype(np.float32)
