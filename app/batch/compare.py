"""Comparison of two finished maps: aligns one with the other and pairs their trees."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np

from app.sources import inspection
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float, Pose2

# Trees within MATCH are the same tree; beyond MOVED its position has changed [m].
MATCH, MOVED = 0.5, 0.1
_LEAST_SIGMA = 0.02

Run = dict[str, Any]


async def compare(a: Run, b: Run, *, same_source: bool) -> dict[str, Any]:
    """Compare two finished runs, both with their `map`.

    Maps of the same recording share a frame. Other maps are aligned by the distances between their stems; if
    that fails, they are compared without alignment, and `how` has the reason.

    Args:
        a, b: The runs.
        same_source: Whether both are of the same recording.

    Returns:
        The tables of the page; positions of b are in the frame of a. `shift_rms_m` is None without a pair.
    """
    known, how = (Pose2(), "same recording") if same_source else await align(a, b)
    pose, how = (Pose2(), f"not aligned: {how}") if known is None else (known, how)
    place_a, place_b = _places(a), pose.apply(_places(b))
    pairs, only_a, only_b = await asyncio.to_thread(
        _paired, a["map"]["trees"], b["map"]["trees"], place_a, place_b
    )
    shifts = np.array([pair["shift_m"] for pair in pairs])
    return {
        "how": how,
        "pose": [pose.x, pose.y, pose.yaw],
        "b_trees": [
            {**tree, "x": round(x, 4), "y": round(y, 4)}
            for tree, (x, y) in zip(b["map"]["trees"], place_b.tolist(), strict=True)
        ],
        "b_path": np.round(pose.apply(_rows(b["map"]["path"])), 3).tolist(),
        "pairs": pairs,
        "only_a": only_a,
        "only_b": only_b,
        "moved": int(np.count_nonzero(shifts > MOVED)),
        "shift_rms_m": float(np.sqrt(np.mean(shifts**2))) if len(shifts) else None,
        "match_m": MATCH,
        "moved_m": MOVED,
        "parameters": _differences(a["parameters"], b["parameters"]),
    }


async def align(a: Run, b: Run) -> tuple[Pose2 | None, str]:
    """Return the pose of map b in map a and how it was found; where it is unknown, None and the reason. It is
    computed in a child process; its errors are returned as the reason.

    Args:
        a, b: Runs with `map`, of which the trees are used.
    """
    try:
        found = await inspection.ask({"ask": "alignment", "local": _stems(b), "reference": _stems(a)})
    except StemmapError as error:
        return None, error.what
    if found["pose"] is None:
        return None, f"their stems do not agree with certainty ({found['reason']})"
    return Pose2(*found["pose"]), f"aligned by {found['stems']} stems"


def _stems(run: Run) -> list[list[float | None]]:
    """Return x, y, sigma, DBH and its sigma [m] of each tree of a run; None for an unknown DBH. Sigma is at
    least 0.02 m."""
    rows = []
    for tree in run["map"]["trees"]:
        known = tree["dbh_cm"] is not None and tree["sigma_dbh_cm"] is not None
        dbh = [tree["dbh_cm"] / 100.0, tree["sigma_dbh_cm"] / 100.0] if known else [None, None]
        rows.append([tree["x"], tree["y"], max(tree["ellipse"][0], _LEAST_SIGMA), *dbh])
    return rows


def _places(run: Run) -> Float:
    """Return the positions of the trees of a run, shape (T, 2) [m]."""
    return _rows([[tree["x"], tree["y"]] for tree in run["map"]["trees"]])


def _rows(points: list[list[float]]) -> Float:
    """Return points as an array of shape (N, 2); (0, 2) for []."""
    return np.array(points, np.float64).reshape(-1, 2)


def _paired(
    a: list[dict[str, Any]], b: list[dict[str, Any]], place_a: Float, place_b: Float
) -> tuple[list[dict[str, Any]], list[int], list[int]]:
    """Return the pairs of trees of both maps, the largest shift first, and the numbers of the trees in only
    one map, for each map.

    Args:
        a, b: Trees of the two maps as on the page.
        place_a, place_b: Their positions in the frame of a, shape (T, 2) [m].
    """
    from pipeline.evaluation import match

    a_of = match(place_b, place_a, MATCH)
    shift = np.hypot(*(place_b - place_a[a_of]).T) if len(place_a) else np.zeros(len(b))
    pairs = [
        {
            "a": a[row]["number"],
            "b": tree["number"],
            "shift_m": round(float(shift[k]), 4),
            "dbh_cm": _change(a[row]["dbh_cm"], tree["dbh_cm"]),
            "moved": bool(shift[k] > MOVED),
        }
        for k, (row, tree) in enumerate(zip(a_of.tolist(), b, strict=True))
        if row >= 0
    ]
    pairs.sort(key=lambda pair: -pair["shift_m"])
    taken = set(a_of.tolist())
    only_a = [tree["number"] for k, tree in enumerate(a) if k not in taken]
    only_b = [tree["number"] for tree, row in zip(b, a_of.tolist(), strict=True) if row < 0]
    return pairs, only_a, only_b


def _change(before: float | None, after: float | None) -> float | None:
    """Return after - before, rounded to 2 decimals; None if one is None."""
    return None if before is None or after is None else round(after - before, 2)


def _differences(a: dict[str, Any], b: dict[str, Any]) -> list[dict[str, Any]]:
    """Return name and both values of each parameter that differs; None for a parameter that one run does not
    have."""
    names = dict.fromkeys([*a, *b])
    return [
        {"name": name, "a": _plain(a.get(name)), "b": _plain(b.get(name))}
        for name in names
        if a.get(name) != b.get(name)
    ]


def _plain(value: Any) -> Any:  # noqa: ANN401 - whatever a parameter is
    """Return a value for JSON: None for NaN and infinity, all else unchanged."""
    return None if isinstance(value, float) and not math.isfinite(value) else value
