"""What was judged from near is judged again once scans look higher."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.classification import ColumnClassifier, ScanView, depth_image
from pipeline.classification.column_classifier import HIGHER, MOST_STALE, seen_higher
from pipeline.classification.features import NAMES
from pipeline.config import preset
from pipeline.detection.free_space import BINS
from pipeline.geometry.poses import Pose2
from pipeline.ground.terrain import SECTORS
from tests.pipeline.classification.clouds import trunk

HIGHEST, FREE = NAMES.index("looked at up to"), NAMES.index("free above the highest return")
LEVEL = np.full((SECTORS, 200), -1.0)


def view(behind, steepest, x=0.0):
    """From 1 m above level ground, before returns 20 m away up to a steepness."""
    return ScanView(Pose2(x, 0.0, 0.0), np.zeros(3), np.zeros(BINS), np.full(BINS, steepest), behind, LEVEL)


def person_then_from_afar(steepest):
    """Somebody 1.7 m tall at (3, 0), seen ten times from 3 m and then with few returns from 15 m, with what
    stands 20 m behind them as high as that."""
    gathering = ColumnClassifier(preset("forest").classification, all_around=True)
    body = trunk(3.0, 0.0, 0.15, top=1.7)
    nothing = depth_image(np.zeros((0, 3), np.float32))
    for k in range(10):
        gathering.add(body, body[:, 2].copy(), k, view(nothing, 0.2))
    turn, up = np.meshgrid(np.linspace(-0.05, 0.05, 30), np.linspace(0.0, steepest, 60))
    far = np.stack([35.0 * np.cos(turn), 35.0 * np.sin(turn), 35.0 * up], axis=-1).reshape(-1, 3)
    few = body[::200].copy()
    few[:, 0] += 12.0  # 15 m before a robot that now stands at -12 m
    for k in range(10, 14):
        gathering.add(few, few[:, 2].copy(), k, view(depth_image(far.astype(np.float32)), steepest, -12.0))
    c = gathering.columns
    return c.figures[np.hypot(c.axis[:, 0] - 3.0, c.axis[:, 1]).argmin()]


def test_few_returns_from_afar_tell_that_a_person_ends():
    low, high = person_then_from_afar(0.02), person_then_from_afar(0.2)
    assert low[HIGHEST] < 2.0
    assert low[FREE] == 0.0
    assert high[HIGHEST] > 3.5
    assert high[FREE] > 1.0


def test_a_column_asks_once_and_few_at_a_time():
    gathering = ColumnClassifier(preset("forest").classification, all_around=True)
    nothing = depth_image(np.zeros((0, 3), np.float32))
    places = [(-6.0, 2.0), (2.0, 2.0), (6.0, -6.0), (10.0, 2.0)]
    points = np.concatenate([trunk(x, y, 0.15, top=1.7) for x, y in places])
    gathering.add(points, points[:, 2].copy(), 0, view(nothing, 0.0))
    assert len(seen_higher(gathering.columns)) == 0, "they know how high it was looked"
    c = gathering.columns
    higher = replace(c, viewed=c.figures[:, HIGHEST] + HIGHER + 0.1 * np.arange(1, len(c.viewed) + 1))
    tiles = seen_higher(higher)
    assert tiles.shape == (MOST_STALE, 2)
    np.testing.assert_array_equal(tiles[0], c.tile[-1], "where was looked highest comes first")
    assert len(np.unique(tiles, axis=0)) == MOST_STALE
