"""Scenarios of simulated runs, and the URIs that select them: `sim:stand?seed=3&sigma=0.03`.

This module needs no compiled kernel, so that a URI is parsed quickly.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Annotated, Any
from urllib.parse import parse_qsl

import msgspec
import numpy as np
from msgspec import Meta

from pipeline.errors import UsageError

Waypoints = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Placed:
    """An object at a given position: its kind ("tree", "pole", "bush" or "person"), x, y [m] and diameter
    [m]."""

    kind: str
    x: float
    y: float
    diameter: float


@dataclass(frozen=True, slots=True)
class Scenario:
    """A scenario: terrain, objects, and the course of the robot.

    Attributes:
        line: Description in one line.
        waypoints: Waypoints x, y of the course [m]; the course is moved and rotated to begin at the origin,
            along x.
        closed: Whether the course is a loop that is driven repeatedly.
        speed: Speed of the robot [m/s].
        duration_s: Default duration of the run [s].
        half_side: Half the side of the square plot around the middle of the course [m].
        slope: Slope of the terrain along x [degrees].
        waves: Amplitude of the longest wave of the terrain [m], and shortest wavelength [m].
        trees: Number of trees.
        dbh: Minimum and maximum DBH [m].
        thin: Shape of the distribution of DBH; a larger value means more thin trees.
        gap: Minimum distance between the surfaces of two trunks [m].
        branchy: Share of the trees with branches below 3.5 m.
        crown_base: Lowest and highest start of a crown [m].
        lean: Standard deviation of the lean [degrees].
        poles, bushes, standing, walking, boxes, undergrowth: Numbers of objects; standing and walking
            persons.
        placed: Objects at given positions in the frame of the map.
        crossings: Persons who walk back and forth between two positions: x, y, x, y [m] and speed [m/s] of
            each.
        obeys: Whether the robot slows down and stops for obstacles in its path.
        odometry: Default quality of the wheels.
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
    odometry: str = field(default="normal", repr=False)


def _ring(radius: float, wobble: float, lobes: int, points: int) -> Waypoints:
    """Return a closed course around the origin as x, y [m], with the radius r + w cos(n a) at angle a.

    Args:
        radius, wobble: Mean radius r and amplitude w [m].
        lobes: Number of lobes n.
        points: Number of waypoints; the first is not repeated.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, points, endpoint=False)
    r = radius + wobble * np.cos(lobes * angle)
    return tuple((float(a), float(b)) for a, b in zip(r * np.cos(angle), r * np.sin(angle), strict=True))


# The table of the paper has seven trees, but their positions have misprints; these are our own.
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

WILD = "wild"
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
        line="A hillside of 14 degrees, up to 20 in parts: heights above a level plane do not work here",
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
    WILD: Scenario(
        line="Rough stems, undergrowth, ditches, logs and street furniture, seen by one of four sensors",
        waypoints=_ring(7.0, 1.2, 3, 18),
        closed=True,
        speed=1.5,
        duration_s=38.0,
        half_side=15.0,
        trees=60,
        odometry="slipping",
    ),
}


def scenarios() -> dict[str, str]:
    """Return a dict from the URI of each scenario, e.g. "sim:stand", to its description."""
    return {f"sim:{name}": scenario.line for name, scenario in SCENARIOS.items()}


@dataclass(frozen=True, slots=True)
class WheelQuality:
    """Errors of wheel odometry.

    Attributes:
        scale: Relative error of the distance; its sign is random.
        slip: Share of the distance lost per unit of uphill slope.
        turn_scale: Relative error of a rotation; its sign is random.
        turn_bias: False rotation per metre [rad/m]; its sign is random.
        distance_noise: Standard deviation of the distance per square root of the distance [m/sqrt(m)].
        turn_noise: Standard deviation of the heading per square root of the distance [rad/sqrt(m)].
        spins: Number of spins of the wheels on soft ground per metre [1/m].
    """

    scale: float
    slip: float
    turn_scale: float
    turn_bias: float
    distance_noise: float
    turn_noise: float
    spins: float = 0.0


QUALITIES = {
    "good": WheelQuality(0.003, 0.01, 0.002, 2e-4, 0.005, 0.002),
    "normal": WheelQuality(0.01, 0.04, 0.006, 6e-4, 0.01, 0.004),
    "poor": WheelQuality(0.03, 0.10, 0.006, 2.8e-3, 0.03, 0.006),
    "slipping": WheelQuality(0.01, 0.04, 0.006, 6e-4, 0.01, 0.004, spins=0.1),
}


SCHEME = "sim:"
EXACT = "exact"
Options = dict[str, tuple[Any, str]]
#: Options of a run: type with bounds, and meaning. Times and sizes are decimal numbers without a sign.
LIDAR_NAMES = ("vlp16", "vlp32", "os0-128", "os1-64", "xt32", "helios", "mid360", "avia", "solid")
OPTIONS: Options = {
    "seed": (Annotated[int, Meta(ge=0, le=2**63 - 1)], "0 to 2^63 - 1"),
    "sigma": (Annotated[float, Meta(ge=0.0, le=0.2)], "range noise in metres, 0 to 0.2"),
    "odometry": (str, f"one of {', '.join([*QUALITIES, EXACT])}"),
    "duration": (Annotated[float, Meta(ge=1.0, le=3600.0)], "seconds, 1 to 3600"),
    "trees": (Annotated[int, Meta(ge=0, le=2000)], "how many, 0 to 2000"),
    "drive": (Annotated[int, Meta(ge=0, le=1000)], "another drive through the same scene, 0 to 1000"),
    "lidar": (str, f"one of {', '.join(LIDAR_NAMES)}"),
}
_NUMBER = re.compile(r"[-+.0-9eE]+")


@dataclass(frozen=True, slots=True)
class RunRequest:
    """Request for a simulated run.

    Attributes:
        name: Name of the scenario.
        seed: Random seed of the run.
        sigma: Standard deviation of a range [m].
        odometry: Quality of the wheels, or "exact".
        duration_s: Duration [s].
        trees: Number of trees.
        drive: Number of the drive; other drives through the same scene have other noise.
        lidar: Name of the sensor, one of LIDAR_NAMES; "" for that of the scenario.
    """

    name: str
    seed: int
    sigma: float
    odometry: str
    duration_s: float
    trees: int
    drive: int = field(default=0, repr=False)
    lidar: str = field(default="", repr=False)

    @property
    def scenario(self) -> Scenario:
        """The scenario with the requested number of trees; KeyError for another name."""
        return replace(SCENARIOS[self.name], trees=self.trees)


def parse_uri(uri: str, seed: int = 0) -> RunRequest:
    """Return the request of `sim:NAME?key=value&...`; "sim:" may be omitted. Options that are missing have
    the defaults of the scenario.

    The duration is 1 s to 3600 s. A scenario with placed objects has at most its default number of trees, the
    others have at most 2000.

    Args:
        uri: As the user wrote it; the part after "?" is percent-encoded.
        seed: Seed of a URI that names none.

    Raises:
        UsageError: No such scenario, key, odometry or LiDAR; a key twice; a part after "?" that is not pairs;
            or a value that is not a number or out of bounds.
    """
    name, _, query = uri.removeprefix(SCHEME).partition("?")
    if name not in SCENARIOS:
        known = ", ".join(SCHEME + scenario for scenario in SCENARIOS)
        raise UsageError(f"there is no scenario {name!r}", where=uri, remedy=f"Scenarios: {known}")
    scenario = SCENARIOS[name]
    values = option_values(uri, query, OPTIONS)
    values.setdefault("seed", seed)
    trees = values.get("trees", scenario.trees)
    if scenario.placed and trees > scenario.trees:
        remedy = f"This scenario has at most {scenario.trees} trees"
        raise UsageError(_refusal(uri, "trees", str(trees), OPTIONS).what, where=uri, remedy=remedy)
    return RunRequest(
        name=name,
        seed=_value(uri, "seed", str(values["seed"]), OPTIONS),
        sigma=values.get("sigma", 0.02),
        odometry=values.get("odometry", scenario.odometry),
        duration_s=values.get("duration", scenario.duration_s),
        trees=trees,
        drive=values.get("drive", 0),
        lidar=values.get("lidar", ""),
    )


def option_values(uri: str, query: str, options: Options) -> dict[str, Any]:
    """Return a dict from the keys to the values of the options of a URI; empty for an empty query. In texts
    "+" is a space; they may be empty.

    Args:
        uri: The URI, for errors.
        query: Part of the URI after "?", percent-encoded.
        options: Valid options.

    Raises:
        UsageError: The query is not key=value pairs, a key is unknown or given twice, or a value has another
            type or is out of bounds.
    """
    allowed = "Options: " + "; ".join(f"{key} ({words})" for key, (_, words) in options.items())
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError:
        raise UsageError(
            "the part after ? must be key=value, joined by &", where=uri, remedy=allowed
        ) from None
    values: dict[str, Any] = {}
    for key, text in pairs:
        if key not in options:
            raise UsageError(f"a simulated run has no option {key!r}", where=uri, remedy=allowed)
        if key in values:
            raise UsageError(f"option {key!r} is given twice", where=uri, remedy="Give it once")
        values[key] = _value(uri, key, text, options)
    if values.get("odometry", EXACT) not in (*QUALITIES, EXACT):
        raise _refusal(uri, "odometry", values["odometry"], options)
    if values.get("lidar", LIDAR_NAMES[0]) not in LIDAR_NAMES:
        raise _refusal(uri, "lidar", values["lidar"], options)
    return values


def _value(uri: str, key: str, text: str, options: Options) -> Any:  # noqa: ANN401 - of the type of the option
    """Return the value of an option; UsageError if the text has another type or is out of bounds."""
    declared = options[key][0]
    kind = getattr(declared, "__origin__", str)
    # Python alone would also take 1_0, spaces and digits of other scripts.
    if kind is not str and not _NUMBER.fullmatch(text):
        raise _refusal(uri, key, text, options)
    try:
        return msgspec.convert(kind(text), declared)
    except (ValueError, msgspec.ValidationError):
        raise _refusal(uri, key, text, options) from None


def _refusal(uri: str, key: str, text: str, options: Options) -> UsageError:
    """Return the error for an option whose value is not valid.

    Args:
        uri: The URI, for the message.
        key: Name of the option.
        text: Value of the option.
        options: Valid options.
    """
    return UsageError(f"option {key} = {text!r} does not fit", where=uri, remedy=f"{key}: {options[key][1]}")
