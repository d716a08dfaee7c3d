"""The laws of a session again, with the real mapper on a simulated run."""

from __future__ import annotations

import numpy as np
import pytest

from app.worker.process import new_session
from app.worker.session import Session
from pipeline.config import Parameters
from pipeline.types.records import Frame

URI = "sim:stand?duration=7"


@pytest.fixture
def session():
    session = new_session()
    session.open(URI, "auto", 3)
    yield session
    session.close()


def stand_at(session: Session, index: int) -> Frame:
    session.advance(index - session.status().scan_index)
    while session.pace == "hurry":
        session.work()
    assert session.frame is not None
    assert session.frame.index == index
    return session.frame


def assert_same(a: Frame, b: Frame) -> None:
    for name in ("raw", "filtered", "labels"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.estimate.T_map_base == b.estimate.T_map_base
    np.testing.assert_array_equal(a.estimate.particles, b.estimate.particles)
    np.testing.assert_array_equal(a.estimate.weights, b.estimate.weights)
    for name in ("number", "position", "covariance", "dbh", "observations"):
        np.testing.assert_array_equal(getattr(a.trees, name), getattr(b.trees, name))


def test_the_real_mapper_comes_back_to_the_same_bytes(session: Session) -> None:
    first = {index: stand_at(session, index) for index in (8, 55, 60)}
    path = session.path
    for index in (8, 60, 55):
        assert_same(stand_at(session, index), first[index])
    stand_at(session, 60)
    assert path is not None
    assert session.path is not None
    np.testing.assert_array_equal(session.path.x, path.x)


def test_a_slider_on_the_standing_scan_and_back_leaves_no_trace(session: Session) -> None:
    before = stand_at(session, 12)
    other = session.set_parameters(Parameters().replace({"clustering.eps": 0.6}), 1)
    assert other is not None
    assert len(other.clusters.size) != len(before.clusters.size)
    again = session.set_parameters(Parameters(), 2)
    assert again is not None
    assert_same(again, before)
    following = stand_at(session, 13)
    stand_at(session, 2)
    assert_same(stand_at(session, 13), following)
