"""What the stages made of each scan of a run, kept in memory so that a change begins where it acts."""

from __future__ import annotations

import numpy as np

from pipeline.classification import judged
from pipeline.config import field_specs
from pipeline.config.stages import Slam
from pipeline.mapper import Noted
from pipeline.remapping.notes import Entry, Notes, Stretch

MOST_BYTES = 512 << 20
# m; no tree is held to a landmark farther from it, whatever the parameters.
FARTHEST = max(float(s.maximum or 0.0) for s in field_specs() if s.name == "tracking.distance_max") + 0.01
STRETCH = 64  # scans that are laid together


class Journal:
    """Of a run's scans from its first on, as long as there is room: a scan for which there is none is not
    noted, and none after it.

    Args:
        most: Bytes that it may take.
    """

    def __init__(self, most: int = MOST_BYTES) -> None:
        self._most = most
        self._notes = Notes()
        self._newest: list[Entry] = []  # not laid together yet
        self._is_full = False

    def __len__(self) -> int:
        return len(self._notes) + len(self._newest)

    @property
    def nbytes(self) -> int:
        """Of what is laid together."""
        return self._notes.nbytes

    def note(self, noted: Noted, slam: Slam) -> None:
        """Take a scan, which is the next one or one that is there; later ones are forgotten."""
        self.cut(noted.index)
        if len(self) < noted.index or self._is_full:
            return  # for one before it there was no room
        self._newest.append(_entry(noted, slam.view_range + FARTHEST))
        if len(self._newest) == STRETCH:
            self._lay_together()

    def cut(self, scans: int) -> None:
        """Keep the first ones alone."""
        if scans < len(self):
            self._is_full = False
            self._notes, left = self._notes.first(scans), max(scans - len(self._notes), 0)
            del self._newest[left:]

    def first(self, scans: int) -> Notes:
        """Of the first scans, or as many as there are. Asking changes nothing: those not laid together
        yet are so for the answer alone."""
        notes = self._notes
        if self._newest and scans > len(notes):
            notes = self._within(notes.with_more(Stretch.of(self._newest)))
        return notes.first(scans)

    def take(self, notes: Notes) -> None:
        """Begin with these."""
        self._notes, self._newest, self._is_full = notes, [], False

    def _lay_together(self) -> None:
        more = self._notes.with_more(Stretch.of(self._newest))
        self._notes, self._newest = self._within(more), []
        self._is_full = len(self._notes) < len(more)

    def _within(self, notes: Notes) -> Notes:
        """The first of them, for which there is room."""
        while notes.nbytes > self._most:
            notes = notes.first(len(notes) - 1)
        return notes


def _entry(noted: Noted, reach: float) -> Entry:
    estimate, found = noted.estimate, noted.found
    place, covariance = noted.landmarks
    pose = estimate.T_map_base
    near = np.hypot(place[:, 0] - pose.x, place[:, 1] - pose.y) < reach
    return Entry(
        stamp_ns=noted.stamp_ns,
        T_map_base=pose,
        covariance=estimate.covariance,
        relative=estimate.relative,
        detections=found.detections,
        heights=found.heights,
        free=noted.scan.free,
        offset=noted.scan.sensor_offset,
        landmarks=(place[near], covariance[near]),
        columns=None if noted.columns is None else judged(noted.columns),
        is_usual=noted.is_usual,
    )
