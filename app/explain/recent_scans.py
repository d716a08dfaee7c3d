"""The scans that people may still be looking at, so that what they click can be told of."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import replace

import numpy as np

from pipeline.types.records import Frame

_MOST = 60  # pictures; at twenty a second a click has three seconds


class Recent:
    """The newest pictures that were sent, without their raw points. Any thread may use it."""

    def __init__(self) -> None:
        self._frames: OrderedDict[tuple[int, int], Frame] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, run: int, frame: Frame) -> None:
        """Remember a picture of a run that is on its way to the browsers."""
        small = replace(frame, raw=np.zeros((0, 3), np.float32))
        with self._lock:
            self._frames[run, frame.index] = small
            self._frames.move_to_end((run, frame.index))
            while len(self._frames) > _MOST:
                self._frames.popitem(last=False)

    def forget(self) -> None:
        """Remember none of them any more."""
        with self._lock:
            self._frames.clear()

    def find(self, run: int, scan: int) -> Frame | None:
        """The picture of a scan as it was sent last; None when that was too long ago."""
        with self._lock:
            return self._frames.get((run, scan))
