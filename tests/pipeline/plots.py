"""Plots in closed form: stems, ground and bushes as points and as LAS files."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def hill(x, y, slope=0.0):
    """Height of the ground: a slope along x with waves on it."""
    return slope * x + 0.2 * np.sin(0.5 * x) + 0.2 * np.cos(0.4 * y)


def ground(side, spacing, rng, slope=0.0, grass=0.02):
    """Points on the ground of a square plot, with grass on it."""
    n = int((side / spacing) ** 2)
    x, y = rng.uniform(0.0, side, (2, n))
    return np.column_stack([x, y, hill(x, y, slope) + np.abs(rng.normal(0.0, grass, n))])


def stem(
    x, y, radius, rng, *, slope=0.0, height=8.0, lean=(0.0, 0.0), taper=0.005, arc=2 * np.pi,
    sigma=0.005, per_m2=1500, turn=0.0,
):  # fmt: skip
    """Points on a leaning cone: x, y and radius are at 1.3 m above the ground at its foot."""
    n = int(per_m2 * arc * radius * height)
    h, a = rng.uniform(0.0, height, n), turn + rng.uniform(-0.5 * arc, 0.5 * arc, n)
    r = np.maximum(radius - taper * (h - 1.3), 0.01) + rng.normal(0.0, sigma, n)
    cx, cy = x + lean[0] * (h - 1.3), y + lean[1] * (h - 1.3)
    return np.column_stack([cx + r * np.cos(a), cy + r * np.sin(a), hill(x, y, slope) + h])


def bush(x, y, rng, slope=0.0, size=0.8, points=1500):
    """A ball of leaves on the ground."""
    offset = rng.normal(0.0, 0.4 * size, (points, 3))
    return np.array([x, y, hill(x, y, slope) + 0.5 * size]) + offset * (1.0, 1.0, 0.7)


PLACES = np.array(
    [(2.0, 2.0, 0.12), (7.5, 2.5, 0.20), (13.0, 3.0, 0.08), (3.0, 8.0, 0.30), (8.0, 8.5, 0.15),
     (13.5, 9.0, 0.25), (2.5, 13.5, 0.10), (9.0, 13.0, 0.18), (13.0, 13.5, 0.14)]
)  # fmt: skip


def plot(rng, *, slope=0.0, sigma=0.005, per_m2=1500):
    """A plot of 15 x 15 m with nine stems (PLACES: x, y, radius), three bushes and noise below the ground."""
    parts = [ground(15.0, 0.05, rng, slope)]
    for k, (x, y, radius) in enumerate(PLACES):
        lean = (0.05 * np.cos(k), 0.05 * np.sin(k))
        parts.append(stem(x, y, radius, rng, slope=slope, lean=lean, sigma=sigma, per_m2=per_m2))
    parts += [bush(x, y, rng, slope) for x, y in ((5.0, 5.0), (11.0, 6.0), (6.0, 11.0))]
    x, y = rng.uniform(0.0, 15.0, (2, 60))
    parts.append(np.column_stack([x, y, hill(x, y, slope) - rng.uniform(0.5, 3.0, 60)]))
    return np.concatenate(parts)


def write_las(path: Path, points, *, offset=(0.0, 0.0, 0.0), crs=None, version="1.4"):
    """Write points (N, 3) [m], moved by `offset`, as LAS or, by the name, LAZ."""
    import laspy

    header = laspy.LasHeader(point_format=6 if version == "1.4" else 3, version=version)
    header.scales, header.offsets = np.full(3, 0.001), np.array(offset)
    if crs is not None:
        import pyproj

        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (points + np.array(offset)).T
    las.write(str(path))
    return path
