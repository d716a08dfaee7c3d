"""Young trees: small, thin ones of many shapes, which a sensor sees end in free air as it does poles."""

from __future__ import annotations

import numpy as np

from app.training.scene_objects import FOLIAGE, TRUNK, Furniture
from pipeline.types.records import Float

KINDS = ("sparse", "dense", "narrow", "bare")


def sapling(furniture: Furniture, x: float, y: float, rng: np.random.Generator) -> None:
    """A young tree at x, y [m]: its crown lets much of the light through, or little, is narrow, or there are
    branches alone; some have one to three stakes, some a second stem."""
    kind = str(rng.choice(KINDS))
    height, radius = float(rng.uniform(2.2, 7.0)), float(rng.uniform(0.02, 0.12))
    base = float(rng.uniform(0.2, 0.75)) * height
    lean = np.tan(np.radians(3.0 * rng.standard_normal(2)))
    foot = furniture.foot(x, y)
    start, end = foot - np.array([0.0, 0.0, 0.3]), foot + np.array([*(height * lean), 0.95 * height])
    owner = furniture.owner(TRUNK)
    furniture.builder.cone(owner, start, end, (1.1 * radius, 0.3 * radius), roughness=0.02 * radius)
    furniture.trunks.append((owner, x, y))
    if rng.random() < 0.1:
        beside = start + np.array([*rng.uniform(-0.1, 0.1, 2), 0.0])
        furniture.builder.cone(
            owner,
            beside,
            end + np.array([*rng.uniform(-0.6, 0.6, 2), -0.2 * height]),
            (0.8 * radius, 0.2 * radius),
        )
    for part in rng.uniform(base / height, 0.95, int(rng.integers(3, 16 if kind == "bare" else 7))):
        _branch(furniture, owner, start + (end - start) * part, 0.35 * (height - base), rng)
    if kind != "bare":
        _crown(furniture, foot, lean, base, height, kind, rng)
    if rng.random() < 0.3:
        _stakes(furniture, x, y, rng)


def _crown(
    furniture: Furniture,
    foot: Float,
    lean: Float,
    base: float,
    height: float,
    kind: str,
    rng: np.random.Generator,
) -> None:
    owner, depth = furniture.owner(FOLIAGE), height - base
    width = float(rng.uniform(0.2, 0.5) if kind == "narrow" else rng.uniform(0.4, 1.0 + 0.2 * height))
    path = float(rng.uniform(0.8, 3.0) if kind == "sparse" else rng.uniform(0.1, 0.8))
    for _ in range(int(rng.integers(1, 8))):
        half = np.array([width, width, 0.5 * depth]) * rng.uniform(0.4, 1.0, 3)
        up = base + float(rng.uniform(half[2], max(depth - half[2], half[2])))
        out = np.maximum(width - half[:2], 0.0) * rng.uniform(-1.0, 1.0, 2)
        centre = foot + np.array([*(up * lean + out), up])
        furniture.builder.ellipsoid(
            owner, centre, half, yaw=float(rng.uniform(0.0, np.pi)), free_path=path, reflectivity=0.5
        )


def _branch(furniture: Furniture, owner: int, start: Float, long: float, rng: np.random.Generator) -> None:
    angle, rise = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.2, 2.0)
    way = np.array([np.cos(angle), np.sin(angle), rise]) * max(long * rng.uniform(0.3, 1.0), 0.15)
    furniture.builder.cone(owner, start, start + way, (float(rng.uniform(0.006, 0.02)), 0.003))


def _stakes(furniture: Furniture, x: float, y: float, rng: np.random.Generator) -> None:
    first, tall = rng.uniform(0.0, 2.0 * np.pi), float(rng.uniform(1.0, 2.4))
    for angle in first + np.arange(int(rng.integers(1, 4))) * 2.0 * np.pi / 3.0:
        away, radius = float(rng.uniform(0.15, 0.5)), float(rng.uniform(0.02, 0.05))
        furniture.post(x + away * np.cos(angle), y + away * np.sin(angle), radius, tall)
