"""Turns: which scans do the works that not every scan needs, so that they do not fall on one scan."""

from __future__ import annotations

ALWAYS = 10  # first scans, so that a short recording is judged on all it has


def is_gathered(index: int, every: int) -> bool:
    """Whether the returns of a scan are gathered, of which every so many are."""
    return index < ALWAYS or index % every == 0


def is_fused(index: int, every: int) -> bool:
    """Whether its ground goes into the height map: midway between two scans that are gathered."""
    return index < ALWAYS or index % every == every // 2
