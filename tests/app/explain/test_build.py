"""A story says what the map says, and its figures are those that decided."""

from __future__ import annotations

import numpy as np
import pytest

from app.explain.build import cluster_story, tree_story
from app.worker.protocol import Open
from app.worker.run import Run
from app.worker.session import Session
from pipeline.errors import StemmapError
from pipeline.types.records import Frame, Verdict


def drive(session: Session) -> Run:
    assert isinstance(session.run, Run)
    return session.run


def frame_of(session: Session) -> Frame:
    assert session.shown.frame is not None
    return session.shown.frame


def test_the_verdict_of_every_cluster_is_that_of_its_first_check_that_fails(session: Session):
    frame = frame_of(session)
    assert len(frame.clusters.size) > 20
    for row in range(len(frame.clusters.size)):
        story = cluster_story(drive(session), frame, row)
        failed = [check.verdict for check in story.checks if check.fails]
        assert story.verdict == (failed[0] if failed else "tree")
        assert story.verdict == Verdict(int(frame.clusters.verdict[row])).label
        assert story.size == frame.clusters.size[row]
        assert len(story.points) == min(story.size, 400)


def test_the_fit_that_is_drawn_is_the_fit_that_was_judged(session: Session):
    frame = frame_of(session)
    for row in frame.detections.cluster:
        story = cluster_story(drive(session), frame, int(row))
        assert story.circle is not None
        assert story.circle.radius == pytest.approx(frame.clusters.radius[row], rel=1e-9)
        assert story.circle.arc_deg == pytest.approx(np.degrees(frame.clusters.arc[row]), rel=1e-9)
        points = np.array(story.points)
        reach = np.hypot(points[:, 0], points[:, 1])
        np.testing.assert_allclose(reach - story.circle.radius, story.residual, atol=1e-12)
        angle = np.arctan2(points[:, 1], points[:, 0])
        beyond = (angle - story.circle.arc_start) % (2 * np.pi)
        # Of many points some are fitted, and the arc is theirs.
        inside = (beyond <= np.radians(story.circle.arc_deg) + 1e-9) | (beyond > 2 * np.pi - 1e-9)
        assert inside.mean() > 0.9
        # The sensor looks from below, so what it sees of a trunk is its lower side.
        assert points[:, 1].mean() < 0.0


def test_a_cluster_of_a_tree_names_the_tree(session: Session):
    frame = frame_of(session)
    trees = frame.trees
    named = [cluster_story(drive(session), frame, int(row)) for row in frame.detections.cluster]
    with_tree = [story for story in named if story.tree is not None]
    assert len(with_tree) > 10
    for story in with_tree:
        place = trees.position[trees.number == story.tree][0]
        gaps = np.hypot(*(trees.position[trees.confirmed] - story.position).T)
        assert np.hypot(*(place - story.position)) == gaps.min()
        assert trees.confirmed[trees.number == story.tree][0]


def test_a_tree_tells_its_votes_its_sides_and_how_it_became_sure(session: Session):
    frame = frame_of(session)
    trees, pose = frame.trees, frame.estimate.T_map_base
    # Columns reach as far as `classification.range_max`, and detections farther.
    near = np.hypot(*(trees.position - [pose.x, pose.y]).T) < 20.0
    rows = np.flatnonzero(trees.confirmed & (trees.observations >= 12) & near)
    assert len(rows) > 5
    for row in rows:
        story = tree_story(drive(session), session.shown.frame, int(trees.number[row]))
        assert 10 * sum(story.sides) == pytest.approx(story.coverage_deg)
        assert story.column is not None
        assert story.column.verdict == "tree"
        assert sum(story.column.votes.values()) == pytest.approx(1.0, abs=0.01)  # leaves are rounded
        assert story.column.by_votes
        assert story.column.votes["tree"] >= story.column.tree_share
        sizes = [abs(each.effect) for each in story.column.effects]
        assert sizes == sorted(sizes, reverse=True)
        assert len(story.history.x) == story.observations
        assert story.history.major[-1] == pytest.approx(story.ellipse[0])
        assert story.history.major[-1] < story.history.major[0]
        assert (story.history.x[-1], story.history.y[-1]) == story.position


def test_what_is_not_there_is_refused_in_words(session: Session):
    frame = frame_of(session)
    with pytest.raises(StemmapError, match="no cluster 9999"):
        cluster_story(drive(session), frame, 9999)
    with pytest.raises(StemmapError, match="tree 9999 is not known"):
        tree_story(drive(session), session.shown.frame, 9999)


def test_a_preset_that_fits_no_circle_is_told_without_one(session: Session):
    from app.worker.process import new_session
    from pipeline.config import preset

    mapped = new_session()
    mapped.open(Open("sim:paper?duration=1", "auto", 3))
    mapped.set_parameters(preset("paper"), 1)
    mapped.play()
    while mapped.pace == "replay":
        mapped.work()
    frame = frame_of(mapped)
    assert len(frame.clusters.size) > 0
    for row in range(len(frame.clusters.size)):
        story = cluster_story(drive(mapped), frame, row)
        assert story.circle is None
        assert story.residual == []
        assert story.column is None
        # The axes are those of the eccentricity.
        (a, b), (c, d) = story.axes
        if np.isfinite(story.eccentricity):
            assert (a * a + b * b) / (c * c + d * d) == pytest.approx(story.eccentricity, rel=1e-3)
