"""A whole cloud in the session: mapped in steps, tuned, explained, and left for a run of scans."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from app.explain.build import section as at_breast
from app.extensions.clouds.inventory import PARAMETERS
from app.scene import Scene
from app.scene.nodes import scan_in_map
from app.worker.one_step_run import OneStepRun
from app.worker.outbox import picture_of
from app.worker.process import new_session, open_any_or_one_step
from app.worker.protocol import Open, Report, Shown, from_worker
from app.worker.session import Session, tree_picture
from pipeline.config import preset
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers.base import SourceOptions
from pipeline.types.records import Frame, Verdict
from tests.app.scene.feet import bases, on_terrain, path_of, within
from tests.app.scene.recorder import Recorder
from tests.pipeline.plots import PLACES, plot, write_las

FOREST = preset("forest")
UTM = (470600.0, 3810200.0, 300.0)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plot with nine stems in UTM coordinates."""
    points = plot(np.random.default_rng(1), slope=0.1, per_m2=900)
    file: Path = tmp_path_factory.mktemp("cloud") / "plot.laz"
    write_las(file, points, offset=UTM, crs="EPSG:26912")
    return file


@pytest.fixture
def session(cloud: Path) -> Iterator[Session]:
    opened = new_session()
    opened.open(Open(str(cloud), "auto", 0))
    opened.set_parameters(FOREST, 1)
    yield opened
    opened.close()


def mapped(session: Session) -> Frame:
    """Play until the cloud is mapped, as the loop of the worker does."""
    session.play()
    while session.pace != "idle":
        session.work()
    assert session.shown.frame is not None
    return session.shown.frame


def again(session: Session) -> Frame:
    """Continue until the inventory that replaces the map is complete."""
    while session.is_remapping:
        session.remap()
    assert session.shown.frame is not None
    return session.shown.frame


def cloud_run(session: Session) -> OneStepRun:
    assert isinstance(session.run, OneStepRun)
    return session.run


def test_a_cloud_is_mapped_in_steps_without_a_robot(session: Session) -> None:
    session.play()
    seen = []
    while session.work() is None:
        seen.append(session.status())
    shares = [float(status.detail.split()[-2]) for status in seen]
    assert {status.state for status in seen} == {"starting"}
    assert len(shares) > 20
    assert shares == sorted(shares)
    frame = mapped(session)
    assert not frame.of_drive
    assert len(frame.trees.number) == len(PLACES)
    away = np.hypot(*(frame.trees.position[:, None] - PLACES[:, :2]).transpose(2, 0, 1))
    assert away.min(axis=1).max() < 0.03
    status = session.status()
    assert (status.state, status.scans, status.scan_index, status.trees) == ("finished", 1, 0, len(PLACES))
    assert status.one_step is not None
    assert status.one_step.offset == (*UTM[:2], 0.0), "heights below 1000 m are kept"
    assert "26912" in status.one_step.crs
    assert status.one_step.parameters == list(PARAMETERS)
    assert set(PARAMETERS) <= set(FOREST.flat())
    assert session.shown.path is not None
    assert len(session.shown.path.x) == 0


@pytest.mark.slow
def test_the_frame_shows_the_cloud_with_the_points_of_each_tree(session: Session) -> None:
    frame = mapped(session)
    at = frame.estimate.T_map_base.apply(frame.filtered[:, :2].astype(np.float64))
    assert at.min() > -0.1
    assert at.max() < 15.1
    trees = np.flatnonzero(frame.clusters.verdict == Verdict.TREE)
    assert sorted(frame.detections.cluster) == sorted(trees)
    for row in trees:
        mine = at[(frame.labels == row) & (frame.filtered[:, 2] > 1.0)]
        assert len(mine) > 100
        assert (
            np.median(
                np.hypot(*(mine - PLACES[np.hypot(*(PLACES[:, :2] - mine.mean(axis=0)).T).argmin(), :2]).T)
            )
            < 0.5
        )
    codec = from_worker()
    assert session.shown.path is not None
    shown = Shown(1, 0.0, picture_of(frame), 0, session.shown.path, None, session.shown.counts)
    there = codec.decode(codec.encode(shown)[4:])
    assert isinstance(there, Shown)
    assert there.counts is not None
    assert session.shown.counts is not None
    np.testing.assert_array_equal(there.counts.covered, session.shown.counts.covered)
    assert replace(there.counts, covered=None) == replace(session.shown.counts, covered=None)
    assert there.counts.verdicts["tree"] == len(PLACES)
    assert not there.frame.of_drive
    np.testing.assert_array_equal(there.frame.trees.lean, frame.trees.lean)
    status = codec.decode(codec.encode(Report(session.status()))[4:])
    assert isinstance(status, Report)
    assert status.status.one_step == session.status().one_step


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pine_plot.laz", "LPine1_demo.laz", "MLS_Clip.laz"])
async def test_stems_of_a_cloud_begin_on_the_terrain_or_within_their_own_points(
    name: str, shared_data: Path
) -> None:
    opened = new_session()
    opened.open(Open(str(shared_data / "forest" / name), "auto", 0))
    opened.set_parameters(FOREST, 1)
    frame = mapped(opened)
    scene = Scene(Recorder(), asyncio.get_running_loop())
    scene.show(frame, path_of(frame))
    trees, points = bases(scene, "/world/trees"), scan_in_map(frame, frame.filtered)
    scene.close()
    opened.close()
    assert len(trees) > 5
    right = on_terrain(frame.ground, trees) | within(points, points, trees)
    assert right.all(), trees[~right]


def test_a_parameter_of_the_inventory_maps_the_cloud_again_and_keeps_the_numbers(session: Session) -> None:
    before = mapped(session)
    session.set_parameters(FOREST.replace({"detection.radius_min": 0.13}), 2)
    assert session.is_remapping
    assert session.shown.frame is before, "the old map is shown until the new one is complete"
    after = again(session)
    thick = set(before.trees.number[PLACES[nearest(before), 2] > 0.135].tolist())
    assert set(after.trees.number.tolist()) == thick
    session.set_parameters(FOREST, 3)
    back = again(session)
    assert back.trees.number.tolist() == before.trees.number.tolist()
    np.testing.assert_array_equal(back.trees.position, before.trees.position)


def nearest(frame: Frame) -> np.ndarray:
    """Row of the true stem of each tree."""
    away = np.hypot(*(frame.trees.position[:, None] - PLACES[:, :2]).transpose(2, 0, 1))
    return np.asarray(away.argmin(axis=1))


@pytest.mark.slow
def test_the_latest_of_several_changes_wins(session: Session) -> None:
    mapped(session)
    for revision, least in enumerate((0.10, 0.20, 0.16), start=2):
        session.set_parameters(FOREST.replace({"detection.radius_min": least}), revision)
        session.remap()
    frame = again(session)
    assert len(frame.trees.number) == np.count_nonzero(PLACES[:, 2] > 0.165)
    assert session.status().revision == 4


@pytest.mark.slow
def test_other_parameters_do_not_map_the_cloud_again(session: Session) -> None:
    before = mapped(session)
    session.set_parameters(FOREST.replace({"clustering.eps": 0.5, "slam.distance_max": 2.0}), 2)
    assert not session.is_remapping
    assert session.shown.frame is before


@pytest.mark.slow
def test_the_story_of_a_tree_has_sections_whose_points_are_on_the_circle(session: Session) -> None:
    frame = mapped(session)
    for row, number in enumerate(frame.trees.number.tolist()):
        story = cloud_run(session).tree_story(number)
        stem = story.extensions["clouds"]
        assert len(stem.sections) == frame.trees.observations[row]
        heights = [section.height for section in stem.sections]
        assert heights == sorted(heights)
        shown = [section for section in stem.sections if section.points]
        assert 3 <= len(shown) <= 9
        assert min(abs(section.height - 1.3) for section in shown) < 0.11
        for section in shown:
            off = np.hypot(*np.array(section.points).T) - section.radius
            assert np.median(np.abs(off)) < 0.02
        true = PLACES[nearest(frame)[row]]
        breast = min(stem.sections, key=lambda section: abs(section.height - 1.3))
        assert breast.radius == pytest.approx(true[2], abs=0.01)
        assert stem.lean_deg == pytest.approx(np.degrees(np.arctan(0.05)), abs=0.5)
        assert np.isnan(stem.height) == bool(stem.height_hidden)
        assert stem.height_hidden or stem.height == pytest.approx(8.0, abs=4.0 * stem.height_sigma)
    with pytest.raises(StemmapError, match="no tree 99"):
        cloud_run(session).tree_story(99)


@pytest.mark.slow
def test_the_section_at_breast_height_shows_each_stem(session: Session) -> None:
    assert session.run is not None
    assert len(at_breast(session.run.accumulated).cells) == 0
    frame = mapped(session)
    found = at_breast(session.run.accumulated)
    centre = np.array(found.origin) + (found.cells + 0.5) * found.side
    away = np.hypot(*(frame.trees.position[:, None] - centre).transpose(2, 0, 1)).min(axis=1)
    assert (away < 0.5 * frame.trees.dbh + found.side).all()
    with pytest.raises(StemmapError, match="no camera"):
        tree_picture(session.run, 1)


@pytest.mark.slow
def test_the_verdict_of_a_candidate_is_that_of_its_first_check_that_fails(session: Session) -> None:
    frame = mapped(session)
    others = 0
    for row in range(len(frame.clusters.verdict)):
        story = cloud_run(session).cluster_story(row)
        assert story.verdict == Verdict(int(frame.clusters.verdict[row])).label
        failed = [check.verdict for check in story.checks if check.fails]
        if story.verdict == "tree":
            assert story.checks
            assert failed == []
        else:
            assert failed == [] or story.verdict == failed[0]
            others += 1
        stem = story.extensions["clouds"]
        assert stem.sections
        assert sum(stem.votes.values()) == pytest.approx(1.0, abs=0.01)
        around = np.array(stem.around)
        assert len(around) > 100
        assert np.hypot(*around[:, :2].T).max() < 0.76
        assert (story.tree is not None) == (story.verdict == "tree")
    assert others == 3, "bushes"
    with pytest.raises(StemmapError, match="no cluster"):
        cloud_run(session).cluster_story(len(frame.clusters.verdict))


@pytest.mark.slow
def test_two_sets_are_compared_without_a_change_of_the_map(session: Session) -> None:
    before = mapped(session)
    few, all_of_them = session.compare([FOREST.replace({"detection.radius_min": 0.2}), FOREST])
    assert len(few.trees.number) < len(all_of_them.trees.number) == len(PLACES)
    assert session.shown.frame is before


@pytest.mark.slow
def test_a_seek_or_another_play_leaves_the_map_as_it_is(session: Session) -> None:
    before = mapped(session)
    session.seek(5.0)
    while session.pace == "hurry":
        session.work()
    assert session.shown.frame is before
    session.play()
    while session.pace != "idle":
        session.work()
    assert session.shown.frame is before


@pytest.mark.slow
def test_a_damaged_cloud_is_refused_and_the_address_of_a_drive_is_no_map(cloud: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.laz"
    broken.write_bytes(cloud.read_bytes()[:300])
    with pytest.raises(SourceError):
        open_any_or_one_step(str(broken), SourceOptions())
    assert open_any_or_one_step(f"file://{cloud}", SourceOptions()).description.kind.startswith("whole cloud")
    drive = open_any_or_one_step(f"sim:cloud?file={cloud}", SourceOptions())
    assert drive.description.has_odometry
    drive.close()


@pytest.mark.slow
def test_a_run_of_scans_follows_a_cloud(session: Session) -> None:
    mapped(session)
    session.open(Open("sim:stand?duration=2", "auto", 0))
    session.set_parameters(FOREST, 2)
    assert session.status().one_step is None
    session.advance(1)
    while session.pace == "hurry":
        session.work()
    assert session.shown.frame is not None
    assert session.shown.frame.of_drive
