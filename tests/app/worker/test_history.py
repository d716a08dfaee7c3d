"""The history of a tree: bounded, and never of a future that was left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.explain.records import half_axes
from app.worker import course as module
from app.worker.course import TreeHistory
from app.worker.outbox import RecentScans
from pipeline.types.records import Frame
from tests.app.fakes import PERIOD_NS, START_NS, frame


def seen(index: int, x: float, numbers: tuple[int, ...] = (1, 2), observations: int = 1):
    """A frame whose trees of these numbers were seen just now, at x."""
    shot = frame(index, START_NS + index * PERIOD_NS, n_trees=3)
    now = np.isin(shot.trees.number, numbers)
    position = shot.trees.position.copy()
    position[:, 0] = x
    trees = replace(
        shot.trees,
        position=position,
        last_seen_ns=np.where(now, shot.stamp_ns, START_NS - 1),
        observations=np.full(3, observations),
    )
    return replace(shot, trees=trees)


def record(history: TreeHistory, shot: Frame) -> None:
    history.record(shot.index, shot.stamp_ns, shot.trees, START_NS)


@given(st.lists(st.integers(0, 30), min_size=1, max_size=60))
def test_the_history_is_the_newest_pass_up_to_the_newest_scan(scans: list[int]):
    history = TreeHistory()
    known: dict[int, float] = {}
    for turn, index in enumerate(scans):
        record(history, seen(index, float(turn)))
        known = {k: x for k, x in known.items() if k < index} | {index: float(turn)}
    story = history.of(1, 10**6)
    assert story.x == [known[k] for k in sorted(known)]
    assert story.time_s == pytest.approx([0.1 * k for k in sorted(known)])
    assert history.of(3, 10**6).x == []


def test_it_is_bounded_and_keeps_the_first_views(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "_MOST_ROWS", 200)
    history = TreeHistory()
    for index in range(3000):
        record(history, seen(index, float(index), observations=index + 1))
        assert len(history._rows) <= 200
    story = history.of(2, 10**6)
    assert story.x[:10] == [float(k) for k in range(10)]
    assert story.x[-1] > 2500


def test_a_long_history_is_story_with_its_ends():
    history = TreeHistory()
    for index in range(1500):
        record(history, seen(index, float(index)))
    story = history.of(1, 10**6)
    assert len(story.x) <= 200
    assert story.x[0] == 0.0
    assert story.x[-1] == 1499.0


@given(st.floats(0.1, 5.0), st.floats(0.01, 1.0), st.floats(-1.5, 1.5))
def test_half_axes_give_the_ellipse_back(major: float, part: float, angle: float):
    minor = part * major
    C = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    a, b, turned = half_axes((C @ np.diag([major**2, minor**2]) @ C.T)[None])[0]
    assert (a, b) == pytest.approx((major, minor), rel=1e-6)
    if part < 0.99:
        assert np.sin(turned - angle) == pytest.approx(0.0, abs=1e-5)


def test_the_newest_scans_are_kept_without_their_raw_points():
    recent = RecentScans()
    for index in range(100):
        recent.keep(1, frame(index, index))
    assert recent.find(1, 10) is None
    assert recent.find(2, 99) is None
    kept = recent.find(1, 99)
    assert kept is not None
    assert len(kept.raw) == 0
    assert len(kept.filtered) > 0
