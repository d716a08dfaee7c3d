"""How far and how long a robot drove on a path of one drive or of several."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from app.batch.saved_run import RunSource
from pipeline.types.records import Path

_SAME_DRIVE = ("origin", "resume")
_NS = 1e-9


def breaks_of(sources: Iterable[RunSource]) -> list[int]:
    """Numbers of the scans with which another drive begins: nobody drove from the scan before to them."""
    return [source.from_scan for source in sources if source.start not in _SAME_DRIVE]


def driven(path: Path, breaks: Iterable[int] = ()) -> tuple[float, float]:
    """Seconds and metres that were driven; neither the jump nor the pause between two drives counts.

    Args:
        path: One row a scan.
        breaks: See `breaks_of`.
    """
    is_step = np.ones(max(len(path.x) - 1, 0), np.bool_)
    is_step[[scan - 1 for scan in breaks if 0 < scan < len(path.x)]] = False
    seconds = float(np.diff(path.stamp_ns)[is_step].sum()) * _NS
    return seconds, float(np.hypot(np.diff(path.x), np.diff(path.y))[is_step].sum())
