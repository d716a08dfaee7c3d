"""Times measured in turns: on a shared machine, two sides must be measured under the same load."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from statistics import median


def in_turns(
    sides: Mapping[str, Callable[[], object]],
    rounds: int,
    *,
    warm: bool = True,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Time each side once per round, A B A B, in milliseconds; if `warm`, call each side once before."""
    for work in sides.values() if warm else ():
        work()
    times: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, work in sides.items():
            start = clock()
            work()
            times[name].append(1e3 * (clock() - start))
    return times


def quantile(values: Sequence[float], part: float) -> float:
    """The smallest value that at least this part of the values does not exceed; NaN of none."""
    if not values:
        return float("nan")
    ordered = sorted(values)
    return ordered[max(0, math.ceil(part * len(ordered)) - 1)]


def middle(values: Sequence[float]) -> float:
    """The median; NaN of none."""
    return median(values) if values else float("nan")
