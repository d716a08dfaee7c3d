"""The scenarios, as one table to read and to extend."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

Waypoints = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Placed:
    """Something that stands at a given place: its kind, x, y [m] and diameter [m]."""

    kind: str
    x: float
    y: float
    diameter: float


@dataclass(frozen=True, slots=True)
class Scenario:
    """What stands where, and how the robot drives through it.

    Attributes:
        line: One line for the menu.
        waypoints: Of the course [m]; it is moved and turned to begin at the origin, along x.
        closed: Whether the course is a loop that is driven again and again.
        speed: [m/s].
        duration_s: Length of the run unless the user asks for another.
        half_side: Half the side of the square plot around the middle of the course [m].
        slope: Of the terrain's plane along x [degrees].
        waves: Amplitude of the terrain's longest wave [m]; shortest wavelength [m].
        trees: How many.
        dbh: Smallest and largest [m].
        thin: Shape of the distribution of DBH; larger means more thin trees.
        gap: Least distance between the surfaces of two trunks [m].
        branchy: Part of the trees with branches below 3.5 m.
        crown_base: Lowest and highest start of a crown [m].
        lean: Standard deviation of the lean [degrees].
        poles, bushes, standing, walking, boxes, undergrowth: How many.
        placed: What stands at a given place, in the frame of the map.
        crossings: Persons who walk to and fro: from x, y to x, y [m], and their speed [m/s].
        obeys: Whether the robot slows down and stops for what stands in its way.
    """

    line: str
    waypoints: Waypoints
    closed: bool
    speed: float
    duration_s: float
    half_side: float
    trees: int
    slope: float = 0.0
    waves: tuple[float, float] = (0.0, 10.0)
    dbh: tuple[float, float] = (0.12, 0.50)
    thin: float = 1.5
    gap: float = 0.9
    branchy: float = 0.35
    crown_base: tuple[float, float] = (3.0, 8.0)
    lean: float = 1.5
    poles: int = 0
    bushes: int = 0
    standing: int = 0
    walking: int = 0
    boxes: int = 0
    undergrowth: int = 0
    placed: tuple[Placed, ...] = ()
    crossings: tuple[tuple[float, float, float, float, float], ...] = field(default=(), repr=False)
    obeys: bool = field(default=False, repr=False)


def _ring(radius: float, wobble: float, lobes: int, points: int) -> Waypoints:
    """A round course that swings in and out, so that it is not just a circle."""
    angle = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False)
    r = radius + wobble * np.cos(lobes * angle)
    return tuple((float(a), float(b)) for a, b in zip(r * np.cos(angle), r * np.sin(angle), strict=True))


# The paper's table gives seven trees, but its positions carry misprints: these are our own.
_PAPER_PLOT = (
    Placed("tree", 3.6, 2.3, 0.30),
    Placed("tree", 6.2, -3.0, 0.42),
    Placed("tree", 9.2, 4.4, 0.25),
    Placed("tree", 12.0, -2.1, 0.36),
    Placed("tree", 15.0, 3.2, 0.50),
    Placed("tree", 18.0, -4.6, 0.22),
    Placed("tree", 21.4, 2.5, 0.33),
    Placed("pole", 7.6, 1.9, 0.08),
    Placed("pole", 16.6, -2.4, 0.12),
    Placed("person", 10.4, 2.4, 0.45),
    Placed("bush", 13.4, 4.4, 1.20),
)

SCENARIOS: dict[str, Scenario] = {
    "stand": Scenario(
        line="A natural stand of 40 x 40 m with poles, bushes, persons and a box; one loop of 75 s",
        waypoints=_ring(9.5, 1.6, 3, 18),
        closed=True,
        speed=0.9,
        duration_s=75.0,
        half_side=20.0,
        trees=52,
        waves=(0.22, 9.0),
        poles=4,
        bushes=6,
        standing=1,
        walking=1,
        boxes=1,
    ),
    "paper": Scenario(
        line="As in the paper: seven trees, two poles, a person and a bush beside a path of 24 m",
        waypoints=((0.0, 0.0), (3.0, 0.0), (8.0, 0.3), (16.0, -0.3), (24.0, 0.0)),
        closed=False,
        speed=0.8,
        duration_s=33.0,
        half_side=20.0,
        trees=7,
        branchy=0.0,
        lean=1.0,
        placed=_PAPER_PLOT,
    ),
    "slope": Scenario(
        line="A hillside of 14 degrees, in parts up to 20, where level bands of height fail",
        waypoints=_ring(9.5, 1.6, 3, 18),
        closed=True,
        speed=0.8,
        duration_s=85.0,
        half_side=20.0,
        trees=52,
        slope=14.0,
        waves=(0.30, 10.0),
        lean=2.0,
        poles=3,
        bushes=6,
        standing=1,
        walking=1,
        boxes=1,
    ),
    "dense": Scenario(
        line="1,500 stems per hectare, thin to thick, with undergrowth and low branches",
        waypoints=_ring(9.0, 1.8, 3, 18),
        closed=True,
        speed=0.7,
        duration_s=90.0,
        half_side=20.0,
        trees=240,
        dbh=(0.07, 0.45),
        thin=2.4,
        gap=0.5,
        branchy=0.6,
        lean=2.0,
        waves=(0.20, 8.0),
        poles=3,
        bushes=12,
        standing=1,
        walking=1,
        undergrowth=160,
    ),
    "long": Scenario(
        line="Ten minutes: a loop of 145 m, driven almost three times, so that it closes twice",
        waypoints=_ring(21.5, 3.2, 4, 32),
        closed=True,
        speed=0.75,
        duration_s=600.0,
        half_side=34.0,
        trees=190,
        waves=(0.30, 10.0),
        poles=8,
        bushes=14,
        standing=2,
        walking=2,
        boxes=3,
    ),
    "crossing": Scenario(
        line="Two persons cross the way and a trunk stands in it: the robot waits, and stops for good",
        waypoints=((0.0, 0.0), (5.0, 0.0), (10.0, 0.2), (15.0, 0.0), (22.0, 0.0)),
        closed=False,
        speed=0.8,
        duration_s=40.0,
        half_side=18.0,
        trees=24,
        placed=(Placed("tree", 18.0, 0.05, 0.40), Placed("pole", 4.0, 0.9, 0.10)),
        crossings=((8.0, -5.0, 8.0, 4.0, 0.5), (13.5, 8.5, 13.5, -3.0, 0.5)),
        obeys=True,
    ),
}


def scenarios() -> dict[str, str]:
    """The scenarios for a menu: URI and one line."""
    return {f"sim:{name}": scenario.line for name, scenario in SCENARIOS.items()}
