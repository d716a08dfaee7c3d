"""Layout: where furniture stands along a street or in a park, drawn at random."""

from __future__ import annotations

import numpy as np

from app.training.scene_objects import Furniture
from pipeline.types.records import Float

LENGTH = 42.0  # m to each side along the street
# How often each thing stands on a lawn beside the trees.
LAWN = {
    "shrub": 0.28, "crown": 0.1, "lamp": 0.1, "sign": 0.08, "post": 0.1, "bin": 0.05, "person": 0.08,
    "motorcycle": 0.06, "hedge": 0.12, "drum": 0.03,
}  # fmt: skip


def lay_street(furniture: Furniture, rng: np.random.Generator) -> None:
    """A carriageway along x; at both sides a verge with furniture, then what bounds the ground behind."""
    for side in (-1.0, 1.0):
        kerb = float(rng.uniform(2.8, 6.0))
        _verge(furniture, side, kerb, rng)
        behind = kerb + float(rng.uniform(1.0, 5.0))
        x = -LENGTH
        while x < LENGTH:
            length = float(rng.uniform(2.0, 14.0))
            start, end = np.array([x, side * behind]), np.array([x + length, side * behind])
            kind = rng.choice(["hedge", "fence", "wall", "house", "shrubs", "nothing"])
            if kind == "hedge":
                furniture.hedge(start, end)
            elif kind == "fence":
                furniture.fence(start, end)
            elif kind == "wall":
                furniture.wall(start, end, float(rng.uniform(0.6, 2.2)), 0.3)
            elif kind == "house":
                back = side * np.array([0.0, float(rng.uniform(3.0, 6.0))])
                furniture.wall(start + back, end + back, float(rng.uniform(4.0, 8.0)), 4.0)
            elif kind == "shrubs":
                for _ in range(int(length)):
                    place = start + (end - start) * rng.random() + side * np.array([0.0, rng.uniform(0, 1.5)])
                    x_shrub, y_shrub = (float(v) for v in place)
                    furniture.shrub(
                        x_shrub, y_shrub, float(rng.uniform(0.3, 1.4)), float(rng.uniform(0.4, 3.2))
                    )
            for _ in range(int(rng.integers(0, 4))):
                place = start + np.array([length * rng.random(), side * rng.uniform(0.8, 8.0)])
                _garden(furniture, place, rng)
            x += length + float(rng.choice([0.0, rng.uniform(0.5, 3.0)]))


def _garden(furniture: Furniture, place: Float, rng: np.random.Generator) -> None:
    kind = rng.choice(["tree", "crown", "shrub", "post", "lamp"], p=[0.3, 0.2, 0.35, 0.1, 0.05])
    x, y = float(place[0]), float(place[1])
    if kind == "tree":
        furniture.tree(x, y)
    elif kind == "crown":
        furniture.crown(x, y)
    elif kind == "shrub":
        furniture.shrub(x, y, float(rng.uniform(0.4, 1.6)), float(rng.uniform(0.5, 3.5)))
    elif kind == "post":
        furniture.post(x, y, float(rng.uniform(0.02, 0.06)), float(rng.uniform(0.8, 2.5)))
    else:
        furniture.lamp(x, y)


def _verge(furniture: Furniture, side: float, kerb: float, rng: np.random.Generator) -> None:
    """Each street has its own mixture: rows of trees, many signs, many cars."""
    names = [
        "tree",
        "lamp",
        "sign",
        "bollard",
        "mast",
        "bin",
        "motorcycle",
        "person",
        "shrub",
        "drum",
        "nothing",
    ]
    mixture = rng.dirichlet([1.2, 0.7, 1.0, 0.4, 0.2, 0.3, 0.5, 0.5, 0.4, 0.3, 0.8])
    x = -LENGTH
    while x < LENGTH:
        y = side * (kerb + float(rng.uniform(0.3, 1.2)))
        name = str(rng.choice(names, p=mixture))
        if name in ("tree", "lamp", "sign", "bin", "person", "drum"):
            getattr(furniture, name)(x, y)
        elif name == "bollard":
            furniture.post(x, y, float(rng.uniform(0.04, 0.12)), float(rng.uniform(0.5, 1.3)))
        elif name == "mast":
            furniture.post(x, y, float(rng.uniform(0.06, 0.16)), float(rng.uniform(3.0, 9.0)))
        elif name == "motorcycle":
            furniture.motorcycle(x, y, float(rng.uniform(0.0, np.pi)))
        elif name == "shrub":
            furniture.shrub(x, y, float(rng.uniform(0.3, 0.9)), float(rng.uniform(0.4, 2.0)))
        x += float(rng.uniform(1.5, 7.0))
    parked = float(rng.choice([0.0, 0.3, 0.8]))
    for x in np.arange(-LENGTH, LENGTH, 6.0):
        if rng.random() < parked and abs(x) > 4.0:
            furniture.car(float(x), side * (kerb - 1.2), float(rng.normal(0.0, 0.03)))


def lay_park(furniture: Furniture, rng: np.random.Generator) -> None:
    """Rows and groups of trees on a lawn, some shrubs, hedges, benches, posts and people."""
    apart, turn = float(rng.uniform(3.0, 9.0)), float(rng.uniform(0.0, np.pi))
    c, s = np.cos(turn), np.sin(turn)
    for row in np.arange(-30.0, 30.0, float(rng.uniform(4.0, 15.0))):
        for along in np.arange(-30.0, 30.0, apart):
            u, v = along + 0.4 * rng.standard_normal(), row + 0.4 * rng.standard_normal()
            x, y = c * u - s * v, s * u + c * v
            if np.hypot(x, y) > 2.5 and rng.random() < 0.7:
                furniture.tree(x, y)
    for _ in range(int(rng.integers(5, 40))):
        x, y = (float(v) for v in rng.uniform(-30.0, 30.0, 2))
        if np.hypot(x, y) < 3.0:
            continue
        kind = rng.choice(list(LAWN), p=list(LAWN.values()))
        if kind == "shrub":
            furniture.shrub(x, y, float(rng.uniform(0.3, 1.6)), float(rng.uniform(0.4, 3.5)))
        elif kind == "post":
            furniture.post(x, y, float(rng.uniform(0.02, 0.1)), float(rng.uniform(0.6, 3.0)))
        elif kind == "motorcycle":
            furniture.motorcycle(x, y, float(rng.uniform(0.0, np.pi)))
        elif kind == "hedge":
            angle = rng.uniform(0.0, np.pi)
            way = rng.uniform(2.0, 10.0) * np.array([np.cos(angle), np.sin(angle)])
            furniture.hedge(np.array([x, y]), np.array([x, y]) + way)
        else:
            getattr(furniture, str(kind))(x, y)
