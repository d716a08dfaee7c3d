"""The column classifier separates stems from other objects over many scans, and `restore` is exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.classification import ColumnClassifier, Forest, ScanView, no_columns, view_by_direction
from pipeline.classification.column_classifier import (
    FOLD,
    GONE_SCANS,
    HIGHER,
    MOST_STALE,
    seen_higher,
)
from pipeline.classification.features import NAMES
from pipeline.classification.forest import CLASSES, DecisionTrees, package_alone
from pipeline.classification.voxel_map import TILE, VoxelMap, corrected_voxels, keys_of, tiles_of
from pipeline.config import preset
from pipeline.detection.free_space import BINS
from pipeline.errors import StemmapError
from pipeline.geometry.pose_arrays import PathCorrection
from pipeline.geometry.poses import Pose2, Pose3
from pipeline.ground.scan_ground import SECTORS
from pipeline.mapper import Mapper
from pipeline.tracking import Tracker
from pipeline.tracking.track_classification import DUE_NS
from pipeline.types.records import Columns, Float32, Scan, Sensor, Step, Verdict
from tests.pipeline.classification.clouds import bush, trunk
from tests.pipeline.strategies import detections, track

FOREST = preset("forest")
NOWHERE_FREE = np.zeros(BINS)


def depth_of(points):
    """Return the depth image of points, shape (N, 3) [m]."""
    return view_by_direction(points, np.zeros(3), True)[1]


NOTHING_SEEN = depth_of(np.zeros((0, 3), np.float32))


def view(free=NOWHERE_FREE, pose=None):
    """From the origin, 1 m above flat ground, as steep as 45 degrees."""
    flat = np.full((SECTORS, 200), -1.0)
    return ScanView(pose or Pose2(), np.zeros(3), free, np.ones(BINS), NOTHING_SEEN, flat)


def gathered(*clouds: Float32, free=NOWHERE_FREE, scans=1):
    gathering = ColumnClassifier(FOREST.classification, all_around=True)
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3), np.float32)
    for k in range(scans):
        gathering.add(points, points[:, 2].copy(), k, view(free))
    return gathering


def at(columns: Columns, x: float, y: float) -> int:
    return int(np.hypot(columns.axis[:, 0] - x, columns.axis[:, 1] - y).argmin())


def test_a_trunk_is_a_tree_and_a_bush_is_none():
    columns = gathered(trunk(5.0, 1.0, 0.15, top=5.9), bush(-5.0, 2.0, 0.7), scans=3).columns
    tree = at(columns, 5.0, 1.0)
    assert columns.verdict[tree] == Verdict.TREE
    assert columns.axis[tree, :2] == pytest.approx([5.0, 1.0], abs=0.03)
    in_bush = np.hypot(columns.axis[:, 0] + 5.0, columns.axis[:, 1] - 2.0) < 0.8
    assert (columns.verdict[in_bush] != Verdict.TREE).all()
    assert columns.share.sum(axis=1) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("radius", [0.07, 0.08])
def test_an_upright_stem_without_visible_crown_is_a_tree_as_one_that_leans(radius):
    votes = []
    for lean in (0.0, np.tan(np.radians(1.7))):
        columns = gathered(trunk(5.0, 1.0, radius, top=4.4, lean=lean, points=600), scans=3).columns
        stem = at(columns, 5.0, 1.0)
        assert columns.verdict[stem] == Verdict.TREE
        votes.append(columns.share[stem, CLASSES.index(Verdict.TREE)])
    assert votes[0] == pytest.approx(votes[1], abs=0.2)


def test_nothing_gathered_is_no_column():
    assert len(gathered().columns.verdict) == 0


def test_who_walked_on_is_moving():
    gathering = gathered(trunk(5.0, 1.0, 0.15, top=1.7), scans=2)
    nothing = np.zeros((0, 3), np.float32)
    for k in range(GONE_SCANS + 3):
        gathering.add(nothing, np.zeros(0, np.float32), 2 + k, view(np.full(BINS, np.inf)))
    columns = gathering.columns
    assert columns.verdict[at(columns, 5.0, 1.0)] == Verdict.MOVING
    assert columns.absent.max() == GONE_SCANS + 3


def test_how_high_a_scan_looked_is_told_from_the_ground():
    columns = gathered(trunk(3.0, 0.0, 0.15)).columns
    assert columns.viewed[at(columns, 3.0, 0.0)] == pytest.approx(
        4.0, abs=0.05
    )  # 3 m out at 45 degrees, plus 1 m


def test_another_forest_votes_on_all_columns_from_the_next_scan_on():
    def sure(name: str, _all_around: bool) -> Forest:
        one, none = np.zeros(1, np.int32), np.full(1, -1, np.int32)
        kind = 0 if name == "package" else 1
        return Forest(DecisionTrees(one, none, np.zeros(1), one, one, np.eye(len(CLASSES))[kind : kind + 1]))

    gathering = ColumnClassifier(FOREST.classification, all_around=True, forests=sure)
    points = trunk(5.0, 1.0, 0.15, top=5.9)
    gathering.add(points, points[:, 2].copy(), 0, view())
    tree = at(gathering.columns, 5.0, 1.0)
    assert gathering.columns.verdict[tree] == Verdict.TREE
    before = gathering.snapshot()
    other = FOREST.replace({"classification.forest": "0" * 16}).classification
    nothing, none = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)
    for restored in (False, True):
        gathering.parameters = other
        if restored:
            gathering.restore(before)
        gathering.add(nothing, none, 1, view())
        assert gathering.columns.share[:, 1].tolist() == [1.0] * len(gathering.columns.verdict)
        assert gathering.columns.verdict[tree] == Verdict.POLE
    assert before.columns.verdict[tree] == Verdict.TREE, "a snapshot stays as it was"


def test_the_forest_of_a_sensor_that_has_moved_votes_on_all_columns_from_the_next_scan_on():
    def by_kind(_name: str, all_around: bool) -> Forest:
        one, none = np.zeros(1, np.int32), np.full(1, -1, np.int32)
        kind = 0 if all_around else 1
        return Forest(DecisionTrees(one, none, np.zeros(1), one, one, np.eye(len(CLASSES))[kind : kind + 1]))

    gathering = ColumnClassifier(FOREST.classification, all_around=False, forests=by_kind)
    points = trunk(5.0, 1.0, 0.15, top=5.9)
    gathering.add(points, points[:, 2].copy(), 0, view())
    standing = gathering.columns
    assert standing.share[:, 1].tolist() == [1.0] * len(standing.verdict) != []
    gathering.all_around = True
    gathering.add(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), 1, view())
    assert gathering.columns.share[:, 0].tolist() == [1.0] * len(standing.verdict)


def test_a_forest_that_cannot_be_read_leaves_the_kind_of_the_sensor_as_it_was():
    def one_kind(name: str, all_around: bool) -> Forest:
        if all_around:
            raise StemmapError("the forest cannot be read")
        return package_alone(name, all_around)

    gathering = ColumnClassifier(FOREST.classification, all_around=False, forests=one_kind)
    for _ in range(2):
        with pytest.raises(StemmapError):
            gathering.all_around = True
        assert not gathering.all_around


def test_going_back_gives_the_same_again():
    clouds = [trunk(4.0 + 0.001 * k, 1.0, 0.1, points=300, seed=k) for k in range(FOLD + 20)]
    gathering = ColumnClassifier(FOREST.classification, all_around=True)
    states, seen = {}, {}
    for k, cloud in enumerate(clouds):
        if k in (0, 5, FOLD - 1, FOLD, FOLD + 7):
            states[k] = gathering.snapshot()
        gathering.add(cloud, cloud[:, 2].copy(), k, view())
        seen[k] = gathering.columns
    for k, state in reversed(states.items()):
        gathering.restore(state)
        for again in range(k, k + 3):
            gathering.add(clouds[again], clouds[again][:, 2].copy(), again, view())
            for name in ("axis", "figures", "share", "verdict", "present", "absent"):
                assert np.array_equal(getattr(gathering.columns, name), getattr(seen[again], name)), (
                    k,
                    again,
                    name,
                )


def test_a_tree_that_no_scan_showed_begins_a_track_and_keeps_its_number():
    columns = gathered(trunk(5.0, 1.0, 0.15, top=5.9), scans=3).columns
    tracker = Tracker(FOREST.tracking)
    for _ in range(3):
        tracker.classify(1, columns, FOREST.classification)
    trees = tracker.trees()
    assert trees.number.tolist() == [1]
    assert trees.confirmed.tolist() == [True]
    assert trees.observations.tolist() == [0]
    assert np.isnan(trees.dbh[0])
    assert trees.position[0] == pytest.approx([5.0, 1.0], abs=0.03)


@pytest.mark.parametrize(("x", "stays"), [(6.0, False), (15.0, True)])
def test_hits_make_no_tree_where_a_column_is_overdue(x, stays):
    """Beside a true trunk something is seen that never stands upright; from afar nobody can say so yet."""
    columns = gathered(trunk(5.0, 1.0, 0.15, top=5.9), scans=3).columns
    tracker = Tracker(FOREST.tracking)
    second = 1_000_000_000
    shown = []
    for k in range(6):
        found = detections([[5.0, 1.0], [x, -3.0]])
        track(tracker, k * second, Pose2(), np.eye(3) * 1e-6, found)
        if k >= 4:
            tracker.classify(k * second, columns, FOREST.classification)
            shown.append(tracker.trees().confirmed.tolist())
    assert 5 * second == DUE_NS
    assert shown == [[True, True], [True, stays]]
    late = gathered(trunk(x, -3.0, 0.15, top=5.9), scans=3).columns
    tracker.classify(2 * DUE_NS, late, FOREST.classification)
    assert tracker.trees().confirmed.tolist() == [True, True], "a column that comes late counts"


def test_hits_count_where_returns_are_gathered_only_from_nearer():
    """Nobody can miss a column at 6 m who remembers no return from farther than 5 m."""
    nothing, near = no_columns(), FOREST.classification.model_copy(update={"range_max": 5.0})
    for parameters, stays in ((FOREST.classification, False), (near, True)):
        tracker = Tracker(FOREST.tracking)
        for stamp_ns in (0, DUE_NS // 2, DUE_NS):
            far = detections([[6.0, -3.0]])
            track(tracker, stamp_ns, Pose2(), np.eye(3) * 1e-6, far)
        tracker.classify(DUE_NS, nothing, parameters)
        assert tracker.trees().confirmed.tolist() == [stays]


@pytest.mark.parametrize(
    ("seen_s", "unseen_s", "stays"),
    [
        (0.4, 0.9, True),
        (0.4, 1.1, False),
        (3.0, 2.9, True),
        (3.0, 3.1, False),
        (20.0, 4.9, True),
        (20.0, 5.1, False),
        (0.4, 61.0, True),  # of another drive, or put back by a loop
    ],
)
def test_hits_make_no_tree_of_who_walked_on(seen_s, unseen_s, stays):
    """Far away, where nothing is gathered and no miss is counted."""
    tracking = FOREST.tracking.model_copy(update={"confirm_time": 0.0})
    tracker, scans = Tracker(tracking), 5
    for k in range(scans):
        stamp_ns = round(1e9 * seen_s * k / (scans - 1))
        found = detections([[20.0, -3.0]])
        track(tracker, stamp_ns, Pose2(), np.eye(3) * 1e-6, found)
    assert tracker.trees().confirmed.tolist() == [True]
    tracker.classify(round(1e9 * (seen_s + unseen_s)), no_columns(), FOREST.classification)
    assert tracker.trees().confirmed.tolist() == [stays]


def test_a_tree_does_not_outlive_its_column_beside_something_else():
    """Who stood beside the robot was a tree by the first votes; their circle lies half a metre off."""
    columns = gathered(trunk(5.0, 1.0, 0.15, top=5.9), scans=3).columns
    for kind, off, stays in (
        (Verdict.MOVING, 0.5, False),
        (Verdict.PERSON, 0.65, False),
        (Verdict.BUSH, 0.75, True),
    ):
        tracker = Tracker(FOREST.tracking)
        tracker.classify(0, columns, FOREST.classification)
        assert tracker.trees().confirmed.tolist() == [True]
        place = tracker.trees().position[0]
        moved = replace(columns, axis=columns.axis.copy(), verdict=np.full_like(columns.verdict, kind))
        moved.axis[:, :2] = place + np.array([0.0, off])
        tracker.classify(1, moved, FOREST.classification)
        assert tracker.trees().confirmed.tolist() == [stays], kind.label


def test_a_piece_that_is_joined_does_not_take_the_verdict_away():
    """A person's arm begins a track of its own for one scan, and is the person's again in the next one."""
    columns = gathered(trunk(5.0, 1.0, 0.15, top=1.7), scans=3).columns
    columns = replace(columns, verdict=np.full(len(columns.verdict), Verdict.PERSON, np.int32))
    tracker = Tracker(FOREST.tracking)
    for k in range(5):
        found = detections([[5.0, 1.0]] if k < 4 else [[5.0, 1.0], [5.0, 1.3]])
        track(tracker, k, Pose2(), np.eye(3) * 1e-6, found)
        if k == 3:
            tracker.classify(k, columns, FOREST.classification)
            assert tracker.trees().confirmed.tolist() == [False]
    assert tracker.trees().confirmed.tolist() == [False]


def test_the_paper_gathers_nothing():
    frame = mapped("paper", trunk(5.0, 1.0, 0.15))
    assert frame.columns is None


def mapped(name, points, scans=3):
    sensor = Sensor("VLP-16", 16, float(np.radians(2.0)), 0.0035)
    mapper = Mapper(preset(name), sensor=sensor, T_base_lidar=Pose3.identity(), seed=0)
    frame = None
    for k in range(scans):
        frame = mapper.process(Step(k, Scan(k * 100_000_000, points.astype(np.float32)), Pose2()))
    assert frame is not None
    return frame


RNG = np.random.default_rng(0)
POOR = {
    "nothing": np.zeros((0, 3)),
    "ten identical points": np.repeat([[3.0, 1.0, 0.5]], 10, axis=0),
    "one plane": np.column_stack([RNG.uniform(-20, 20, (20000, 2)), np.full(20000, -1.0)]),
    "a wall": np.column_stack([np.full(20000, 5.0), RNG.uniform(-8, 8, 20000), RNG.uniform(-1, 3, 20000)]),
    "no ground": RNG.uniform(-20, 20, (20000, 3)),
}


@pytest.mark.parametrize("kind", POOR)
def test_a_poor_cloud_gives_a_frame_and_no_tree(kind):
    frame = mapped("forest", POOR[kind])
    assert not frame.trees.confirmed.any()


def filled(side: int, room: int) -> VoxelMap:
    """A square of tiles with a voxel in each corner and in the middle of every one."""
    memory = VoxelMap.empty(1 << 14, room)
    corners = np.array([[0.2, 0.2], [3.8, 0.2], [0.2, 3.8], [3.8, 3.8], [2.0, 2.0]])
    origin = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 1, 2) * TILE
    places = (origin + corners).reshape(-1, 2)
    points = np.column_stack([places, np.full(len(places), 1.3)]).astype(np.float32)
    memory.add(points, 5, 1 << 14)
    return memory


@pytest.mark.parametrize("turn", [0.0, 0.4, np.pi / 4])
@pytest.mark.parametrize("side", [3, 15])  # 15: as many tiles as there is room for, but a few
def test_a_map_that_is_turned_over_more_tiles_stays_whole(side, turn):
    memory = filled(side, 256)
    assert memory.tiles == side**2
    before = np.array([[0.0, 0.0, 0.0], [30.0, 30.0, 0.0]])
    correction = PathCorrection(before, before + np.array([0.9, 0.7, turn]))
    fresh = corrected_voxels(memory, correction)
    assert len(fresh.tile_key) > fresh.tiles >= memory.tiles
    assert int(fresh.returns[: fresh.used].sum()) == int(memory.returns[: memory.used].sum())
    keys = fresh.key[: fresh.used]
    np.testing.assert_array_equal(keys_of(fresh.mean[: fresh.used]), keys)
    np.testing.assert_array_equal(fresh.tile_key[fresh.home[: fresh.used]], tiles_of(keys))
    assert int(fresh.tile_returns[: fresh.tiles].sum()) == int(memory.tile_returns[: memory.tiles].sum())
    # Each tile's chain holds its voxels, each once.
    seen = 0
    for tile in range(fresh.tiles):
        row = int(fresh.tile_first[tile])
        while row >= 0:
            assert fresh.home[row] == tile
            row, seen = int(fresh.following[row]), seen + 1
    assert seen == fresh.used


HIGHEST, FREE = NAMES.index("looked at up to"), NAMES.index("free above the highest return")
LEVEL = np.full((SECTORS, 200), -1.0)


def far_view(behind, steepest, x=0.0):
    """From 1 m above level ground, before returns 20 m away up to a steepness."""
    return ScanView(Pose2(x, 0.0, 0.0), np.zeros(3), np.zeros(BINS), np.full(BINS, steepest), behind, LEVEL)


def person_then_from_afar(steepest):
    """Somebody 1.7 m tall at (3, 0), seen ten times from 3 m and then with few returns from 15 m, with what
    stands 20 m behind them as high as that."""
    gathering = ColumnClassifier(preset("forest").classification, all_around=True)
    body = trunk(3.0, 0.0, 0.15, top=1.7)
    nothing = depth_of(np.zeros((0, 3), np.float32))
    for k in range(10):
        gathering.add(body, body[:, 2].copy(), k, far_view(nothing, 0.2))
    turn, up = np.meshgrid(np.linspace(-0.05, 0.05, 30), np.linspace(0.0, steepest, 60))
    far = np.stack([35.0 * np.cos(turn), 35.0 * np.sin(turn), 35.0 * up], axis=-1).reshape(-1, 3)
    few = body[::200].copy()
    few[:, 0] += 12.0  # 15 m before a robot that now stands at -12 m
    for k in range(10, 14):
        gathering.add(few, few[:, 2].copy(), k, far_view(depth_of(far.astype(np.float32)), steepest, -12.0))
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
    nothing = depth_of(np.zeros((0, 3), np.float32))
    places = [(-6.0, 2.0), (2.0, 2.0), (6.0, -6.0), (10.0, 2.0)]
    points = np.concatenate([trunk(x, y, 0.15, top=1.7) for x, y in places])
    gathering.add(points, points[:, 2].copy(), 0, far_view(nothing, 0.0))
    assert len(seen_higher(gathering.columns)) == 0, "they know how high it was looked"
    c = gathering.columns
    higher = replace(c, viewed=c.figures[:, HIGHEST] + HIGHER + 0.1 * np.arange(1, len(c.viewed) + 1))
    tiles = seen_higher(higher)
    assert tiles.shape == (MOST_STALE, 2)
    np.testing.assert_array_equal(tiles[0], c.tile[-1], "where was looked highest comes first")
    assert len(np.unique(tiles, axis=0)) == MOST_STALE
