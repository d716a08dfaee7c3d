"""Point clouds of one trunk or one bush, for tests."""

from __future__ import annotations

import numpy as np

from pipeline.types.records import Float32


def trunk(
    x: float,
    y: float,
    radius: float,
    *,
    top: float = 4.0,
    lean: float = 0.0,
    points: int = 4000,
    seed: int = 0,
) -> Float32:
    """The surface of a trunk, float32, shape (N, 3): x, y, height [m]; it leans along x."""
    rng = np.random.default_rng(seed)
    turn, h = rng.uniform(0.0, 2.0 * np.pi, points), rng.uniform(0.05, top, points)
    r = radius + 0.01 * rng.standard_normal(points)
    rows = np.stack([x + lean * (h - 1.3) + r * np.cos(turn), y + r * np.sin(turn), h], axis=1)
    return rows.astype(np.float32)


def bush(x: float, y: float, radius: float, *, points: int = 6000, seed: int = 0) -> Float32:
    """A ball of leaves that stands on the ground."""
    rng = np.random.default_rng(seed)
    way = rng.standard_normal((points, 3))
    way *= (radius * rng.uniform(0.2, 1.0, points) / np.linalg.norm(way, axis=1))[:, None]
    rows: Float32 = (way + np.array([x, y, radius])).astype(np.float32)
    return rows
