"""A run mapped again from its first scan, a few scans at a time, while the run itself stands or goes on."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from app.explain.estimate_history import TreeHistory
from app.worker.snapshots import Snapshots
from pipeline.config import Parameters
from pipeline.remapping import Recalled, Rerun
from pipeline.types.records import Frame

_NS = 1_000_000_000
_TRACKED = 128  # scans of which the trees alone are found anew: a few milliseconds


@dataclass(slots=True)
class Told:
    """What is remembered of a run beside its map.

    Attributes:
        history: What each scan made of the trees.
        confirmed_s: When each tree was first confirmed, by its number [s since the first scan].
        time_s: Of the scan that was recorded last.
    """

    history: TreeHistory = field(default_factory=TreeHistory)
    confirmed_s: dict[int, float] = field(default_factory=dict)
    time_s: float = -math.inf

    def record(self, frame: Frame | Recalled, start_ns: int) -> None:
        """Take a scan, or several, of a run whose first one was at this time. What was known of these and
        later scans is forgotten: the run went back."""
        self.history.record(frame, start_ns)
        first_ns = frame.stamps_ns[0] if isinstance(frame, Recalled) else frame.stamp_ns
        if (first_ns - start_ns) / _NS <= self.time_s:
            self._forget_from((first_ns - start_ns) / _NS)
        self.time_s = (frame.stamp_ns - start_ns) / _NS
        if isinstance(frame, Recalled):
            number, scan = frame.confirmed
            at_ns = frame.stamps_ns[scan - frame.first]
        else:
            number = frame.trees.number[frame.trees.confirmed]
            at_ns = np.full(len(number), frame.stamp_ns)
        for tree, time_s in zip(number.tolist(), ((at_ns - start_ns) / _NS).tolist(), strict=True):
            self.confirmed_s.setdefault(tree, time_s)

    def _forget_from(self, time_s: float) -> None:
        self.confirmed_s = {number: at for number, at in self.confirmed_s.items() if at < time_s}

    def before(self, scan: int, time_s: float) -> Told:
        """Of its own, what was known before a scan of this time."""
        earlier = {number: at for number, at in self.confirmed_s.items() if at < time_s}
        return Told(self.history.before(scan), earlier, time_s)


class Remapping:
    """A run as other parameters map it from its first scan on.

    Args:
        rerun: At its beginning.
        start_ns: Time of the run's first scan.
        told: Of the scans that the rerun has passed over.
        known: States of the mapper at some of these.

    Attributes:
        told: Of all scans that are mapped.
    """

    def __init__(
        self, rerun: Rerun, start_ns: int, told: Told | None = None, known: dict[int, Any] | None = None
    ) -> None:
        self.rerun = rerun
        known = {0: rerun.state()} if known is None else known
        self.snapshots: Snapshots[Any] = Snapshots(known[0])
        for scans, state in sorted(known.items()):
            self.snapshots.offer(scans, state)
        self.told = told or Told()
        self._start_ns = start_ns

    @property
    def parameters(self) -> Parameters:
        """With which the run is mapped."""
        return self.rerun.mapper.parameters

    def work(self, scans: int, until: int) -> bool:
        """Map so many scans more, or more where that takes next to nothing, or go back, towards a map of
        `until` scans. Whether it is reached.

        Raises:
            StemmapError: A scan cannot be looked at again.
        """
        rerun = self.rerun
        if rerun.done > until:  # the run went back meanwhile
            rerun.go_back(*self.snapshots.newest(until))
        alone = rerun.tracks_alone
        most = min(rerun.done + (max(scans, _TRACKED) if alone else scans), until)
        while rerun.done < most and rerun.tracks_alone == alone:
            if self.snapshots.is_due(rerun.done) and (state := rerun.state()) is not None:
                self.snapshots.offer(rerun.done, state)
            for frame in rerun.frames(self.snapshots.next_due(rerun.done, most)):
                self.told.record(frame, self._start_ns)
                if rerun.tracks_alone != alone:  # what follows takes its time
                    break
        return rerun.done == until
