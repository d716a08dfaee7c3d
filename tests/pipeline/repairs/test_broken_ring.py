"""A ring whose ends do not meet, with other faults, is mended by ten repairs; they hold after re-mapping."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipeline.config import preset
from pipeline.geometry.columns import rows_of
from pipeline.geometry.poses import Pose2
from pipeline.repairs.record import Kind, Repair, parse_repairs, repairs_text, seen_from
from pipeline.repairs.repaired import MapOfRun, RepairedMap, Repairer, _joined
from pipeline.repairs.trees import numbers_of, repaired_trees
from pipeline.types.records import Float, Health
from tests.benchmarks.broken_ring import DOUBLE, GHOSTS, POLES, TWIN, FaultyRing
from tests.benchmarks.wide_ring import NS, mapped
from tests.pipeline import strategies

STEMS = preset("stems")


@cache
def run(seed: int, method: str = "none", **changes: int) -> tuple[MapOfRun, Float]:
    """Return what the mapper knows at the end of a ring, and the true poses."""
    values = {name.replace("__", "."): value for name, value in changes.items()}
    of = mapped(FaultyRing(), seed, STEMS.replace({"relocalisation.method": method, **values}))
    mapper = of.mapper
    return MapOfRun(of.frames[-1], mapper.path, mapper.graph, mapper.tree_landmarks), of.truth


def errors(position: Float, trees: Float, truth: Float) -> Float:
    """Distance of each tree that was seen well to the nearest one of the map [m]."""
    seen = np.hypot(*(truth[:, None, :2] - trees[None]).transpose(2, 0, 1)) < 13.0
    wanted = trees[seen.sum(axis=0) >= 15]
    error: Float = np.hypot(*(wanted[:, None] - position[None]).transpose(2, 0, 1)).min(axis=1)
    return error


class Person:
    """Repairs a map by clicks on what it shows, and knows the stand."""

    def __init__(self, of: MapOfRun) -> None:
        self.run, self.repairs = of, list[Repair]()
        self._repairer = Repairer()

    @property
    def shown(self) -> RepairedMap:
        return self._repairer.repaired(self.run, self.repairs)

    def click(self, place: Float) -> tuple[float, float]:
        """Return the position in the map of the tree nearest to a place."""
        trees = self.shown.frame.trees
        position = trees.position[trees.confirmed]
        x, y = position[np.argmin(np.hypot(*(position - place).T))].tolist()
        return x, y

    def repair(self, kind: Kind, *places: Float | tuple[float, float], value: str = "") -> None:
        self.repairs.append(Repair(kind, tuple((float(x), float(y)) for x, y in places), value=value))
        assert self.shown.problems[-1] == ""

    def tie(self, trees: Float, truth: Float) -> None:
        """Tie the two copies of the tree nearest to the last part of the way that stands clearly at both."""
        shown = self.shown
        path, views = shown.path, list[tuple[int, tuple[float, float]] | None]()
        for tree in trees[np.argsort(np.hypot(*(truth[-30, :2] - trees).T))]:
            near, views = np.hypot(*(truth[:, :2] - tree).T), []
            for scan in (int(np.argmin(near[:300])), 300 + int(np.argmin(near[300:]))):
                pose = Pose2(path.x[scan], path.y[scan], path.yaw[scan])
                place = pose.apply(Pose2(*truth[scan]).inverse().apply(tree))
                is_clear = np.hypot(*np.subtract(self.click(place), place)) < 0.3
                views.append(seen_from(shown.frame.trees, path, self.click(place)) if is_clear else None)
            if all(views):
                break
        stamps, places = zip(*views, strict=True)
        self.repairs.append(Repair("tie", places, stamps))
        assert self.shown.problems[-1] == ""


@cache
def repaired(seed: int) -> Person:
    """Return a person who has repaired the ring by ten repairs."""
    of, truth = run(seed)
    trees, copied, twin = FaultyRing().scene(np.random.default_rng([9, seed]))
    person = Person(of)
    person.tie(trees, truth)
    for tree in copied:
        person.repair("merge", person.click(tree), person.click(tree + DOUBLE))
    for place in POLES:
        person.repair("class", person.click(place), value="pole")
    for place in GHOSTS:
        person.repair("delete", person.click(place))
    person.repair("split", person.click(twin), twin + TWIN)
    person.repair("move", person.click(twin), twin)
    assert len(person.repairs) == 10
    return person


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("seed", [0, 1])
def test_ten_repairs_mend_a_broken_ring(seed):
    of, truth = run(seed)
    trees, _, twin = FaultyRing().scene(np.random.default_rng([9, seed]))
    trees = np.concatenate([trees, (twin + TWIN)[None]])
    before = of.frame.trees.position[of.frame.trees.confirmed]
    found = repaired(seed).shown.frame.trees
    after = found.position[found.confirmed]
    assert np.hypot(*(of.path.x - truth[:, 0], of.path.y - truth[:, 1])[:2]).max() > 5.0, "it is broken"
    assert len(before) > 1.3 * len(after), "trees stand twice before"
    error = errors(after, trees, truth)
    assert np.median(error) < 0.2
    assert np.mean(error < 0.5) > 0.9
    apart = np.hypot(*(after[:, None] - after[None]).transpose(2, 0, 1)) + 9.0 * np.eye(len(after))
    assert np.count_nonzero(apart.min(axis=1) < 1.0) <= 4, "only the twins and their neighbours"


@pytest.mark.slow
def test_the_quality_of_the_pose_is_said_to_be_of_the_map_before_the_tie():
    of, person = run(1)[0], repaired(1)
    assert of.frame.health.reason.startswith("the position is uncertain by")
    tie, *others = person.repairs
    tied = Repairer().repaired(of, [tie]).frame.health
    assert tied.state == of.frame.health.state
    assert tied.reason == f"before the repairs: {of.frame.health.reason}"
    assert Repairer().repaired(of, others[:2]).frame.health == of.frame.health
    estimate = replace(of.frame.estimate, health=Health(), covariance=1e-4 * np.eye(3))
    good = Repairer().repaired(replace(of, frame=replace(of.frame, estimate=estimate)), [tie]).frame.health
    assert good == Health(reason="before the repairs")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_repairs_hold_after_the_run_was_mapped_again(seed):
    again, truth = run(seed, slam__particles=30)
    trees, _, twin = FaultyRing().scene(np.random.default_rng([9, seed]))
    person = repaired(seed)
    found = Repairer().repaired(again, parse_repairs(repairs_text(person.repairs), "a file"))
    assert sum(map(bool, found.problems)) <= 1, found.problems
    after = found.frame.trees.position[found.frame.trees.confirmed]
    error = errors(after, np.concatenate([trees, (twin + TWIN)[None]]), truth)
    assert np.median(error) < 0.2
    assert np.mean(error < 0.5) > 0.9


@pytest.mark.slow
def test_each_undone_repair_gives_the_map_before_it():
    person = repaired(0)
    of, done = person.run, person.repairs
    shown = [Repairer().repaired(of, done[:n]).frame.trees for n in range(len(done) + 1)]
    back = Repairer()
    for n in range(len(done), -1, -1):
        trees = back.repaired(of, done[:n]).frame.trees
        np.testing.assert_array_equal(trees.position, shown[n].position)
        np.testing.assert_array_equal(trees.confirmed, shown[n].confirmed)
    assert back.repaired(of, []).frame.trees is of.frame.trees


@pytest.mark.slow
def test_a_forbidden_loop_lets_the_odometry_lead_and_a_tie_brings_the_map_back():
    of, truth = run(0, "constellation")
    loop = of.graph.loops[-1].scans
    forbid = Repair("forbid", stamps_ns=tuple(int(of.path.stamp_ns[scan]) for scan in loop))
    free = Repairer().repaired(of, [forbid])
    assert free.problems == ("",)
    assert not len(free.loops)
    error = np.hypot(free.path.x - truth[:, 0], free.path.y - truth[:, 1])
    assert error.max() > 5.0
    tie = Person(of)
    tie.repairs.append(forbid)
    trees = FaultyRing().scene(np.random.default_rng([9, 0]))[0]
    tie.tie(trees, truth)
    both = Repairer().repaired(of, tie.repairs)
    assert both.problems == ("", "")
    error = np.hypot(both.path.x - truth[:, 0], both.path.y - truth[:, 1])
    assert error[-100:].max() < 0.5


def test_the_end_of_a_playing_run_has_the_map_of_a_run_that_did_not_play():
    of, _ = run(0)
    repairs = repaired(0).repairs
    playing = Repairer()
    early = MapOfRun(of.frame, of.path, of.graph, of.landmark)
    playing.repaired(early, repairs, hurried=True)
    one, other = (each.repaired(of, repairs).frame.trees for each in (playing, Repairer()))
    np.testing.assert_array_equal(one.position, other.position)


def test_a_loop_that_the_mapper_closed_meanwhile_makes_the_repair_anew():
    of, _ = run(0, "constellation")
    assert of.graph.loops
    open_ring = replace(of, graph=replace(of.graph, loops=()))
    ties = [repair for repair in repaired(0).repairs if repair.kind == "tie"]
    playing = Repairer()
    playing.repaired(open_ring, ties)
    hurried = playing.repaired(of, ties, hurried=True).path
    np.testing.assert_array_equal(hurried.x, Repairer().repaired(of, ties).path.x)


def test_only_trees_that_a_repair_brought_together_are_merged():
    near = strategies.trees([[0.0, 0.0], [0.4, 0.0], [9.0, 0.0]])
    moved = replace(near, position=near.position * [[1.0, 1.0], [1.0, 1.0], [0.02, 1.0]])
    np.testing.assert_array_equal(_joined(near, near.position).number, near.number)
    assert len(_joined(moved, near.position).number) == 2


def test_repairs_without_their_trees_or_places_say_so():
    of, _ = run(0)
    later = int(of.path.stamp_ns[-1]) + NS
    repairs = [
        Repair("delete", ((500.0, 0.0),)),
        Repair("tie", ((1.0, 0.0), (1.0, 0.0)), (1, later)),
        Repair("forbid", stamps_ns=(1, int(of.path.stamp_ns[-1]))),
        Repair("class", ((500.0, 0.0),), value="tree"),
        Repair("tie", ((1.0, 0.0), (1.0, 0.0)), (later, 1)),
        Repair("forbid", stamps_ns=(int(of.path.stamp_ns[0]) - 1, int(of.path.stamp_ns[-1]))),
    ]
    found = Repairer().repaired(of, repairs)
    assert "no tree is within" in found.problems[0]
    assert "not come to this place" in found.problems[1]
    assert "no loop between" in found.problems[2]
    assert "no candidate is within" in found.problems[3]
    assert "not come to this place" in found.problems[4]
    assert "begins after this place" in found.problems[5]
    assert len(found.frame.trees.number) == len(of.frame.trees.number)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_stems_around_a_tie_tell_a_wrong_one(seed):
    of, truth = run(seed)
    person = Person(of)
    person.tie(FaultyRing().scene(np.random.default_rng([9, seed]))[0], truth)
    (right,) = person.repairs
    ((agree, of_all),) = person.shown.agreeing
    assert agree > 0.8 * of_all
    x, y = seen_place(of, right)
    trees = of.frame.trees
    away = np.hypot(*(trees.position - [x, y]).T)
    for row in np.argsort(away)[1:4]:  # stems beside the right one
        view = seen_from(trees, of.path, tuple(trees.position[row].tolist()))
        assert view is not None
        wrong = Person(of)
        wrong.repairs.append(Repair("tie", (right.places[0], view[1]), (right.stamps_ns[0], view[0])))
        ((agree, of_all),) = wrong.shown.agreeing
        assert agree < 0.4 * of_all


def seen_place(of: MapOfRun, tie: Repair) -> Float:
    """Return where the second stem of a tie stands in the map before it [m]."""
    scan = int(np.searchsorted(of.path.stamp_ns, tie.stamps_ns[1]))
    pose = Pose2(of.path.x[scan], of.path.y[scan], of.path.yaw[scan])
    place: Float = pose.apply(np.array(tie.places[1]))
    return place


def test_a_deleted_thing_is_gone_with_its_copies():
    of, _ = run(0)
    trees = of.frame.trees
    row = int(np.flatnonzero(trees.confirmed)[0])
    copies = rows_of(trees, np.append(np.arange(len(trees.number)), row))
    copies.number[-1] = trees.number.max() + 1
    copies.position[-1] += [0.05, 0.03]  # m; the stems overlap
    x, y = trees.position[row].tolist()
    for repair in (Repair("delete", ((x, y),)), Repair("class", ((x, y),), value="pole")):
        assert set(numbers_of(copies, repair)) == {trees.number[row], copies.number[-1]}
        after, problem = repaired_trees(copies, repair)
        assert problem == ""
        left = after.position[after.confirmed]
        assert np.hypot(*(left - [x, y]).T).min() > 0.5
        assert np.count_nonzero(after.confirmed) == np.count_nonzero(trees.confirmed) - 1
