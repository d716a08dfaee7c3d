"""Recorded scans give what a tracker makes of them one by one, however many trees there come to be."""

from __future__ import annotations

import numpy as np

from pipeline.config import preset
from pipeline.geometry.poses import Pose2
from pipeline.io.checkpoints import encode
from pipeline.remapping.notes import Entry, Stretch
from pipeline.tracking import Tracker
from pipeline.tracking.recorded import Tracking
from pipeline.types.records import Int32
from tests.pipeline.strategies import NOTHING_SEEN, detections

FOREST = preset("forest")
SURE = 1e-6 * np.eye(3)


def test_room_is_made_for_as_many_trees_as_there_are():
    x, y = np.meshgrid(np.arange(35) * 3.0, np.arange(20) * 3.0)
    nothing: Int32 = np.zeros(0, np.int32)
    tracker, entries = Tracker(FOREST.tracking), []
    none = (np.zeros((0, 2)), np.zeros((0, 3)))
    for k in range(5):
        found = detections(np.column_stack([x.ravel() + 200.0 * min(k, 3), y.ravel()]))
        entries.append(
            Entry(k * 10**8, Pose2(), SURE, None, found, None, NOTHING_SEEN, np.zeros(3), none, None, True)
        )
        tracker.process(k * 10**8, Pose2(), SURE, found, NOTHING_SEEN, FOREST.slam.view_range)
        tracker.anchor(*none, Pose2(), FOREST.slam.view_range)
    again, stretch = Tracking(FOREST), Stretch.of(entries)
    seen = again.track(stretch.recorded, nothing, 0, 5, 0)
    assert len(tracker.tracks) > 2048
    assert encode(again.tracks) == encode(tracker.tracks)
    assert again.next_number == tracker.next_number
    assert set(again.tracks.number.tolist()) == set(seen.number.tolist()), (
        "the nearest had no landmark and went"
    )
