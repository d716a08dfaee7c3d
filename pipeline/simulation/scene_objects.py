"""What stands in a scene, each built of solids: trees, poles, bushes, boxes, undergrowth, persons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.simulation.primitives import Solids, SolidsBuilder
from pipeline.types.records import Float

BREAST_HEIGHT = 1.3
TAPER = 0.01  # of the diameter, per metre of height
_FOOT = 0.4  # trunks begin under the ground, so that no gap shows on a slope


@dataclass(frozen=True, slots=True)
class TreeShape:
    """A tree: its trunk's axis at 1.3 m above its ground stands at x, y [m].

    Attributes:
        x, y: [m].
        dbh: Diameter at 1.3 m [m].
        lean: Shift of the axis per metre of height along x and y [1].
        top: Height of the trunk above its ground [m].
        crown_base: Where the foliage begins [m]; above `top` for none.
        branches: Number of branches below the crown.
    """

    x: float
    y: float
    dbh: float
    lean: tuple[float, float]
    top: float
    crown_base: float
    branches: int

    def axis(self, height: float) -> tuple[float, float]:
        """Where the axis is at a height above the tree's ground [m]."""
        up = height - BREAST_HEIGHT
        return self.x + self.lean[0] * up, self.y + self.lean[1] * up

    def radius(self, height: float) -> float:
        """Radius of the trunk at a height [m]."""
        return max(0.5 * (self.dbh - TAPER * (height - BREAST_HEIGHT)), 0.015)


def add_tree(
    builder: SolidsBuilder, owner: int, tree: TreeShape, ground: float, rng: np.random.Generator
) -> None:
    """A tapered, leaning trunk with rough bark, branches and a crown."""
    top = min(tree.top, BREAST_HEIGHT + (tree.dbh - 0.04) / TAPER)
    ends = [np.array([*tree.axis(h), ground + h]) for h in (-_FOOT, top)]
    bark = min(0.012 * tree.dbh, 0.004)
    shade = rng.uniform(0.25, 0.45)
    radii = (tree.radius(-_FOOT), tree.radius(top))
    builder.cone(owner, ends[0], ends[1], radii, reflectivity=shade, roughness=bark)
    for _ in range(tree.branches):
        _add_branch(builder, owner, tree, ground, shade, rng)
    if tree.crown_base < tree.top:
        _add_crown(builder, owner, tree, ground, rng)


def _add_branch(
    builder: SolidsBuilder,
    owner: int,
    tree: TreeShape,
    ground: float,
    shade: float,
    rng: np.random.Generator,
) -> None:
    height = rng.uniform(0.6, min(3.5, tree.crown_base))
    direction, rise = rng.uniform(0.0, 2.0 * np.pi), np.tan(rng.uniform(-0.2, 0.7))
    length = rng.uniform(0.4, 1.3)
    start = np.array([*tree.axis(height), ground + height])
    way = np.array([np.cos(direction), np.sin(direction), rise])
    radius = rng.uniform(0.006, 0.018)
    end = start + (length + tree.radius(height)) * way
    builder.cone(owner, start, end, (radius, 0.003), reflectivity=shade)


def _add_crown(
    builder: SolidsBuilder, owner: int, tree: TreeShape, ground: float, rng: np.random.Generator
) -> None:
    width = np.clip(0.9 + 3.0 * tree.dbh, 1.0, 2.4)
    depth = tree.top + 0.8 - tree.crown_base
    for n in range(3):
        middle = tree.crown_base + depth * (n + 0.5) / 3.0
        half = np.array([width, width, depth / 5.0]) * rng.uniform(0.75, 1.1, 3) * (1.0 - 0.18 * n)
        shift = 0.2 * width * rng.standard_normal(2)
        x, y = tree.axis(middle)
        centre = np.array([x + shift[0], y + shift[1], ground + max(middle, tree.crown_base + half[2])])
        builder.ellipsoid(owner, centre, half, yaw=rng.uniform(0.0, np.pi), free_path=1.2, reflectivity=0.5)


def add_pole(
    builder: SolidsBuilder,
    owner: int,
    x: float,
    y: float,
    radius: float,
    ground: float,
    rng: np.random.Generator,
) -> None:
    """A straight, upright pole of 1.8 to 4 m."""
    top = ground + rng.uniform(1.8, 4.0)
    builder.cone(owner, [x, y, ground - 0.3], [x, y, top], (radius, radius), reflectivity=0.6)


def add_bush(
    builder: SolidsBuilder,
    owner: int,
    x: float,
    y: float,
    radius: float,
    ground: float,
    rng: np.random.Generator,
) -> None:
    """Two or three porous blobs near the ground, with thin stems inside."""
    for _ in range(int(rng.integers(2, 4))):
        half = radius * rng.uniform(0.6, 0.9, 3) * np.array([1.0, 1.0, 0.9])
        at = np.array([x, y]) + (radius - half[:2].max()) * rng.uniform(-0.8, 0.8, 2)
        centre = [at[0], at[1], ground + 0.75 * half[2]]
        builder.ellipsoid(owner, centre, half, yaw=rng.uniform(0.0, np.pi), free_path=0.22, reflectivity=0.5)
    for _ in range(4):
        lean = rng.uniform(-0.35, 0.35, 2) * radius
        end = [x + lean[0], y + lean[1], ground + radius]
        builder.cone(owner, [x, y, ground - 0.05], end, (0.012, 0.004))


def add_box(
    builder: SolidsBuilder, owner: int, x: float, y: float, ground: float, rng: np.random.Generator
) -> None:
    """A piece of wall or a crate, 0.8 to 2.4 m long and 1 to 1.8 m high."""
    half = np.array([rng.uniform(0.4, 1.2), rng.uniform(0.12, 0.4), rng.uniform(0.5, 0.9)])
    builder.box(owner, [x, y, ground + half[2] - 0.2], half, yaw=rng.uniform(0.0, np.pi))


def add_undergrowth(
    builder: SolidsBuilder, owner: int, x: float, y: float, ground: float, rng: np.random.Generator
) -> None:
    """A tuft of ferns or grass, up to half a metre high."""
    half = np.array([rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.5), rng.uniform(0.15, 0.5)])
    centre = [x, y, ground + 0.1 * half[2]]
    builder.ellipsoid(owner, centre, half, yaw=rng.uniform(0.0, np.pi), free_path=0.35, reflectivity=0.45)


def person(owner: int, stride: float = 0.0) -> Solids:
    """A person of 1.74 m at the origin who looks along x.

    Args:
        owner: Number of the thing.
        stride: Swing of the legs and arms [rad], 0 when standing.
    """
    builder = SolidsBuilder()
    for side in (-1.0, 1.0):
        swing = side * np.sin(stride)
        hip: Float = np.array([0.0, 0.10 * side, 0.86])
        foot = hip + 0.86 * np.array([swing, 0.02 * side, -np.cos(stride)])
        builder.cone(owner, foot, hip, (0.055, 0.085), reflectivity=0.3)
        shoulder = np.array([0.0, 0.24 * side, 1.42])
        hand = shoulder + 0.62 * np.array([-0.7 * swing, 0.06 * side, -np.cos(stride)])
        builder.cone(owner, hand, shoulder, (0.035, 0.05), reflectivity=0.4)
    builder.ellipsoid(owner, [0.0, 0.0, 1.14], [0.13, 0.22, 0.38], reflectivity=0.45)
    builder.ellipsoid(owner, [0.0, 0.0, 1.62], [0.10, 0.08, 0.12], reflectivity=0.5)
    return builder.build()
