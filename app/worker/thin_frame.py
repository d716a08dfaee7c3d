"""The picture of a scan for people: at most as many points as an eye and a browser can take. The map is
made of all of them before.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.types.records import Frame

MOST_POINTS = 200_000
NOT_DRAWN = "not drawn"


def picture_of(frame: Frame) -> Frame:
    """The frame with at most MOST_POINTS raw and MOST_POINTS filtered points, taken evenly; the count
    "not drawn" says how many were left out."""
    raw, filtered = _evenly(len(frame.raw)), _evenly(len(frame.filtered))
    left_out = len(frame.raw) - len(raw) + len(frame.filtered) - len(filtered)
    if left_out == 0:
        return frame
    return replace(
        frame,
        raw=frame.raw[raw],
        filtered=frame.filtered[filtered],
        labels=frame.labels[filtered],
        counts={**frame.counts, NOT_DRAWN: left_out},
    )


def for_comparison(frame: Frame) -> Frame:
    """The picture without what is the same under all parameters or is not drawn: the raw points, the
    gathered columns and the ground."""
    return picture_of(replace(frame, raw=np.zeros((0, 3), np.float32), columns=None, ground=None))


def _evenly(n: int) -> NDArray[np.int64]:
    """Rows of a table of n rows, at most MOST_POINTS of them and none twice."""
    return np.arange(n) if n <= MOST_POINTS else np.arange(MOST_POINTS) * n // MOST_POINTS
