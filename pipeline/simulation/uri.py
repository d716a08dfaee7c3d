"""`sim:stand?seed=3&sigma=0.03`: what a person may ask of a simulated run, read strictly."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from urllib.parse import parse_qsl

from pipeline.errors import UsageError
from pipeline.simulation.odometry_quality import QUALITIES
from pipeline.simulation.scenarios import SCENARIOS, Scenario

SCHEME = "sim:"
EXACT = "exact"
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?", re.ASCII)
_KEYS = {
    "seed": "0 to 2^63 - 1",
    "sigma": "range noise in metres, 0 to 0.2",
    "odometry": f"one of {', '.join([*QUALITIES, EXACT])}",
    "duration": "seconds, 1 to 3600",
    "trees": "how many, 0 to 2000",
    "drive": "another drive through the same scene, 0 to 1000",
    "obstacles": "obey (slow down and stop for them) or ignore",
}
_OBSTACLES = ("obey", "ignore")
CLOUD = "cloud"
_CLOUD_KEYS = {
    "file": "the cloud of a plot: .laz, .las, .ply, .npy, .npz or .pcd",
    "truth": "a table (CSV) of its trees in the coordinates of the cloud",
    **{key: meaning for key, meaning in _KEYS.items() if key not in ("trees", "drive", "obstacles")},
}


@dataclass(frozen=True, slots=True)
class RunRequest:
    """A simulated run as it was asked for.

    Attributes:
        name: Of the scenario.
        seed: Of everything random in the run.
        sigma: Standard deviation of a range [m].
        odometry: Quality of the wheels, or "exact".
        duration_s: [s].
        trees: How many stand there.
        drive: Other drives through the same scene have other noise.
        obeys: Whether the robot slows down and stops for what stands in its way.
        file, truth: Of a run through a real cloud: its file, and the table of its trees, or empty.
    """

    name: str
    seed: int
    sigma: float
    odometry: str
    duration_s: float
    trees: int
    drive: int = field(default=0, repr=False)
    obeys: bool = field(default=False, repr=False)
    file: str = ""
    truth: str = ""

    @property
    def scenario(self) -> Scenario:
        """The scenario with as many trees as were asked for."""
        return replace(SCENARIOS[self.name], trees=self.trees)


def parse_uri(uri: str, seed: int = 0) -> RunRequest:
    """Read `sim:NAME?key=value&...`; "sim:" may be left out.

    Args:
        uri: As the user wrote it.
        seed: Taken where the URI names none.

    Raises:
        UsageError: No such scenario or key, a key twice, a value that is no number or out of bounds.
    """
    name, _, query = uri.removeprefix(SCHEME).partition("?")
    if name == CLOUD:
        return _parse_cloud(uri, query, seed)
    if name not in SCENARIOS:
        known = ", ".join(SCHEME + scenario for scenario in SCENARIOS)
        raise UsageError(f"there is no scenario {name!r}", where=uri, remedy=f"Scenarios: {known}")
    values = _pairs(uri, query, _KEYS)
    scenario = SCENARIOS[name]
    odometry = values.get("odometry", "normal")
    if odometry not in (*QUALITIES, EXACT):
        raise _refusal(uri, "odometry", odometry)
    obstacles = values.get("obstacles", _OBSTACLES[0] if scenario.obeys else _OBSTACLES[1])
    if obstacles not in _OBSTACLES:
        raise _refusal(uri, "obstacles", obstacles)
    most = 2000 if not scenario.placed else scenario.trees
    return RunRequest(
        name=name,
        seed=_whole(uri, "seed", values.get("seed", str(seed)), 2**63 - 1),
        sigma=_real(uri, "sigma", values.get("sigma", "0.02"), 0.0, 0.2),
        odometry=odometry,
        duration_s=_real(uri, "duration", values.get("duration", str(scenario.duration_s)), 1.0, 3600.0),
        trees=_whole(uri, "trees", values.get("trees", str(scenario.trees)), most),
        drive=_whole(uri, "drive", values.get("drive", "0"), 1000),
        obeys=obstacles == _OBSTACLES[0],
    )


def _parse_cloud(uri: str, query: str, seed: int) -> RunRequest:
    """A run through a real cloud; a duration of 0 stands for one loop."""
    values = _pairs(uri, query, _CLOUD_KEYS)
    if not values.get("file"):
        raise UsageError(
            "the cloud to be driven through is not named", where=uri, remedy="sim:cloud?file=plot.laz"
        )
    odometry = values.get("odometry", "normal")
    if odometry not in (*QUALITIES, EXACT):
        raise _refusal(uri, "odometry", odometry)
    return RunRequest(
        name=CLOUD,
        seed=_whole(uri, "seed", values.get("seed", str(seed)), 2**63 - 1),
        sigma=_real(uri, "sigma", values.get("sigma", "0.02"), 0.0, 0.2),
        odometry=odometry,
        duration_s=_real(uri, "duration", values["duration"], 1.0, 3600.0) if "duration" in values else 0.0,
        trees=0,
        file=values["file"],
        truth=values.get("truth", ""),
    )


def _pairs(uri: str, query: str, keys: dict[str, str]) -> dict[str, str]:
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError:
        raise UsageError(
            "the part after ? must be key=value, joined by &", where=uri, remedy=_allowed(keys)
        ) from None
    values: dict[str, str] = {}
    for key, value in pairs:
        if key not in keys:
            raise UsageError(f"a simulated run has no option {key!r}", where=uri, remedy=_allowed(keys))
        if key in values:
            raise UsageError(f"option {key!r} is given twice", where=uri, remedy="Give it once")
        values[key] = value
    return values


def _allowed(keys: dict[str, str]) -> str:
    return "Options: " + "; ".join(f"{key} ({meaning})" for key, meaning in keys.items())


def _refusal(uri: str, key: str, text: str) -> UsageError:
    return UsageError(f"option {key} = {text!r} does not fit", where=uri, remedy=f"{key}: {_KEYS[key]}")


def _whole(uri: str, key: str, text: str, most: int) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 20 and int(text) <= most):
        refusal = _refusal(uri, key, text)
        if key == "trees" and most < 2000:
            refusal = UsageError(refusal.what, where=uri, remedy=f"This scenario has at most {most} trees")
        raise refusal
    return int(text)


def _real(uri: str, key: str, text: str, low: float, high: float) -> float:
    # float() alone would also take 1_0, spaces and digits of other scripts.
    if not (len(text) < 40 and _NUMBER.fullmatch(text)):
        raise _refusal(uri, key, text)
    value = float(text)
    if not low <= value <= high:
        raise _refusal(uri, key, text)
    return value
