"""Classification of the trees by the voxel columns at their positions."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.hash_grid import (
    Cells,
    cell_of,
    cells_for,
    fill,
    first_of_four,
    nearest_in,
    per_metre,
    put_in,
)
from pipeline.geometry.ordering import ascending_rows
from pipeline.geometry.poses import Float
from pipeline.jit import compiled, compiled_borrowing
from pipeline.tracking.observation import SECTORS, sides_of
from pipeline.tracking.track_table import Rows, ScanPose
from pipeline.types.records import AT_ROUND, CLASSES, RING_FAR, Bool, Columns, Int, Int32, Verdict

TREE, OTHER = int(Verdict.TREE), int(Verdict.OTHER)
ONE_TREE = 0.5  # m; tree columns nearer to each other are one tree
REACH = 0.45  # m; maximum distance between a track and its column
# m; scale of the distance between a trunk's track and the axis of its column: of the tracks that are the only
# one in reach, 95 of 100 are within 0.16 m in sim:stand and within 0.12 m in sim:dense.
OWN = 0.15
# m; the surroundings that decide the class of a column contain the returns at the axis, 0.3 m around it, of
# any stem nearer than this.
SHARED_SURROUNDINGS = RING_FAR + 0.3
NEIGHBOUR = 0.7  # m; a tree without a column of its own takes the class of a column this near
DUE_NS = 5_000_000_000  # ns after the first observation, when a trunk within DUE_REACH has a column
DUE_REACH = 10.0  # m
DUE_SHARE = 0.4  # of the range of the columns; trees farther away may have few scans with returns
GLIMPSE_NS, FORMER_NS = 1_000_000_000, 60_000_000_000  # bounds of the time in `_is_out_of_sight`
ROUND_REACH = 0.25  # m; maximum distance between a round track and the axis of its column
ROUND_FITS = 20  # circles of single scans
ROUND_SIDES = SECTORS // 2  # sectors
TREE_VOTES = CLASSES.index(Verdict.TREE)
_KINDS, _AT_ROUND = np.array(CLASSES, np.int64), np.array(AT_ROUND)


@compiled
def classify(
    tracks: Rows,
    scan: ScanPose,
    axis: Float,
    votes: Float,
    verdict: Int32,
    tree_share: float,
    range_max: float,
    hits_to_confirm: int,
) -> Int:
    """Assign the classes of the columns to the tracks at their positions; see `confirm_round`,
    `_take_classes` and `_assign_trees`, which are applied in this order.

    Args:
        tracks: The tracks, changed in place.
        scan: Pose of the robot.
        axis: Axes of the columns in the map, x, y first, shape (C, 2 or more) [m].
        votes: Shares of the votes in the order of CLASSES, shape (C, 6).
        verdict: Classes by votes and rules, shape (C,), changed in place by `confirm_round`.
        tree_share, range_max: See `Classification`.
        hits_to_confirm: See `Tracking`.

    Returns:
        Rows of the tree columns without a track, int64, those with most votes for tree first. The caller
        begins new tracks there.
    """
    columns = verdict.shape[0]
    cells, scale = cells_for(columns), per_metre(NEIGHBOUR)
    fill(cells, axis, columns, scale)
    confirm_round(tracks, cells, scale, axis, votes, verdict, tree_share)
    trees, was_tree = _best_first(axis, votes, verdict), tracks.verdict == TREE
    _take_classes(tracks, scan, cells, scale, axis, verdict, min(DUE_REACH, DUE_SHARE * range_max))
    return _assign_trees(tracks, was_tree, axis, trees, hits_to_confirm)


@compiled_borrowing
def confirm_round(
    tracks: Rows,
    cells: Cells,
    scale: float,
    axis: Float,
    votes: Float,
    verdict: Int32,
    tree_share: float,
) -> None:
    """Change the class of columns to tree, in place, if a track within ROUND_REACH has at least ROUND_FITS
    radii and ROUND_SIDES observed sectors.

    Such an object is round and upright, so that the votes for bush, wall and other count little:
    v_tree / (v_round + 0.1 v_else) must be at least `tree_share`, with the shares v of the votes, and neither
    pole nor person may have more votes than tree.

    Args:
        tracks: The tracks.
        cells, scale: Grid of the columns, for searches within ROUND_REACH at least.
        axis, votes, verdict, tree_share: See `classify`. Moving columns and those with too few voxels keep
            their class.
    """
    for t in range(tracks.radii.shape[0]):
        if tracks.radii[t] < ROUND_FITS or sides_of(tracks.sides[t]) < ROUND_SIDES:
            continue
        x, y = tracks.x[t, 0], tracks.x[t, 1]
        u, v = first_of_four(x, y, scale)
        for quarter in range(4):
            c = cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))]
            while c >= 0:
                dx, dy = axis[c, 0] - x, axis[c, 1] - y
                is_near = dx * dx + dy * dy < ROUND_REACH * ROUND_REACH
                if is_near and _is_tree_if_round(votes[c], verdict[c], tree_share):
                    verdict[c] = TREE
                c = cells.following[c]


@compiled_borrowing
def _is_tree_if_round(votes: Float, verdict: int, tree_share: float) -> bool:
    """Return whether a column becomes a tree because its track is round: tree has at least as many votes as
    pole and person, and at least `tree_share` of the votes weighted by AT_ROUND.

    Args:
        votes: Shares of the votes of the column in the order of CLASSES, shape (6,).
        verdict: Class of the column; only a class by votes other than tree can change.
        tree_share: Minimum share, inclusive.
    """
    voted, below, most = False, 0.0, 0.0
    for k in range(_KINDS.shape[0]):
        voted = voted or (verdict == _KINDS[k] and k != TREE_VOTES)
        below += votes[k] * _AT_ROUND[k]
        if _AT_ROUND[k] == 1.0:
            most = max(most, votes[k])
    return voted and votes[TREE_VOTES] >= most and votes[TREE_VOTES] / max(below, 1e-9) >= tree_share


def tree_columns(columns: Columns) -> Int:
    """Return the rows of the columns of class tree, int64, those with most votes for tree first, of equal
    ones the lower row. Of columns nearer than ONE_TREE to each other, only the first remains."""
    return _best_first(columns.axis, columns.share, columns.verdict)


@compiled
def _best_first(axis: Float, votes: Float, verdict: Int32) -> Int:
    """Return the rows of the columns of class tree, int64, those with most votes for tree first, without
    those within ONE_TREE of an earlier one.

    Args:
        axis: Axes of the columns, x, y first, shape (C, 2 or more) [m].
        votes: Shares of the votes, tree first, shape (C, 6).
        verdict: Classes of the columns, shape (C,).
    """
    rows, fewest, n = np.empty(verdict.shape[0], np.int64), np.empty(verdict.shape[0]), 0
    for c in range(verdict.shape[0]):
        if verdict[c] == TREE:
            rows[n], fewest[n] = c, -votes[c, 0]
            n += 1
    rows = rows[ascending_rows(fewest[:n])]
    cells, scale, apart = cells_for(axis.shape[0]), per_metre(ONE_TREE), 0
    for k in range(n):
        c = rows[k]
        if nearest_in(cells, axis, axis[c, 0], axis[c, 1], ONE_TREE, scale) < 0:
            put_in(cells, axis, c, scale)
            rows[apart] = c
            apart += 1
    best: Int = rows[:apart].copy()
    return best


@compiled_borrowing
def _take_classes(
    tracks: Rows,
    scan: ScanPose,
    cells: Cells,
    scale: float,
    axis: Float,
    verdict: Int32,
    due_reach: float,
) -> None:
    """Give each track the class of the nearest column, in place.

    A column within REACH decides; its class tree becomes other, since `_assign_trees` assigns the trees
    afterwards. A tree without a column within REACH takes the class of a column within NEIGHBOUR unless that
    is tree. A track without class gets the class other if its column is overdue (`_is_due`) or it is out of
    sight (`_is_out_of_sight`), so that its hits do not confirm it. Any other track keeps its class.

    Args:
        tracks: The tracks.
        scan: Pose of the robot.
        cells, scale: Grid of the columns for searches within NEIGHBOUR.
        axis, verdict: Axes and classes of the columns.
        due_reach: Distance within which a column is expected [m].
    """
    for t in range(tracks.verdict.shape[0]):
        x, y, known = tracks.x[t, 0], tracks.x[t, 1], tracks.verdict[t]
        near = nearest_in(cells, axis, x, y, NEIGHBOUR, scale)
        found = np.int64(verdict[near]) if near >= 0 else known
        if near >= 0 and (axis[near, 0] - x) ** 2 + (axis[near, 1] - y) ** 2 < REACH * REACH:
            tracks.verdict[t] = OTHER if found == TREE else found
        elif known == TREE and near >= 0 and found != TREE:
            tracks.verdict[t] = found
        elif known < 0 and (
            _is_due(tracks, t, scan, due_reach)
            or _is_out_of_sight(tracks.first_ns[t], tracks.stamp_ns[t], scan.stamp_ns)
        ):
            tracks.verdict[t] = OTHER


@compiled
def classify_new(tracks: Rows, axis: Float, verdict: Int32) -> None:
    """Give tracks with detections and without class the class of the nearest column within REACH, in place.

    It is called between two scans that update the columns; otherwise the hits would confirm a track at a
    column of another class. A track at a column of class tree gets the class other, because another track is
    the tree of that column.

    Args:
        tracks: The tracks.
        axis: Axes of the columns, x, y first, shape (C, 2 or more) [m].
        verdict: Classes of the columns after `classify`, shape (C,).
    """
    for t in range(tracks.verdict.shape[0]):
        if tracks.verdict[t] >= 0 or tracks.hits[t] == 0:
            continue
        nearest, least = -1, REACH * REACH
        for c in range(verdict.shape[0]):
            dx, dy = axis[c, 0] - tracks.x[t, 0], axis[c, 1] - tracks.x[t, 1]
            if dx * dx + dy * dy < least:
                nearest, least = c, dx * dx + dy * dy
        if nearest >= 0:
            found = np.int64(verdict[nearest])
            tracks.verdict[t] = OTHER if found == TREE else found  # another track has the tree of this column


@compiled_borrowing
def _is_due(tracks: Rows, t: int, scan: ScanPose, reach: float) -> bool:
    """Return whether a tree at the position of track t would have a column by now: it is within `reach` [m]
    of the robot, and DUE_NS have passed since its first observation."""
    dx, dy = tracks.x[t, 0] - scan.pose[0], tracks.x[t, 1] - scan.pose[1]
    return bool(dx * dx + dy * dy < reach * reach and scan.stamp_ns - tracks.first_ns[t] >= DUE_NS)


@compiled_borrowing
def _is_out_of_sight(first_ns: int, last_ns: int, now_ns: int) -> bool:
    """Return whether a track has been unobserved for longer than it was observed, like a person who walked
    on.

    The limit is the observed time, at least GLIMPSE_NS and at most DUE_NS. A track that has been unobserved
    for FORMER_NS or longer belongs to an earlier pass of the robot and is not rejected. The arguments are the
    times of the first and the last observation and of the present scan [ns].
    """
    unseen = now_ns - last_ns
    return min(max(last_ns - first_ns, GLIMPSE_NS), DUE_NS) < unseen < FORMER_NS


@compiled
def _assign_trees(tracks: Rows, was_tree: Bool, axis: Float, trees: Int, fewest: int) -> Int:
    """Assign each tree column to one track, which becomes a tree; an assigned track without detections moves
    to the axis.

    Each column in their order takes the track within REACH with the highest likelihood (see `_likeliest`)
    that is not assigned yet. The class of a column depends on its surroundings: a column without a track or
    with one without detections is a branch, a stake or undergrowth of a detected stem nearby
    (`_detected_stem_near`), which becomes a tree, or of such a column within SHARED_SURROUNDINGS whose track
    was a tree already, else of one with more votes.

    Args:
        tracks: The tracks, changed in place.
        was_tree: Whether each track was a tree before, shape (T,).
        axis: Axes of the columns, x, y first, shape (C, 2 or more) [m].
        trees: Rows of the tree columns, those with most votes first.
        fewest: Minimum number of detections of a detected track.

    Returns:
        Rows of the columns without a track, int64, in their order.
    """
    count = tracks.verdict.shape[0]
    taken, new, n = np.zeros(count, np.bool_), np.empty(trees.shape[0], np.int64), 0
    cells, scale = cells_for(count), per_metre(SHARED_SURROUNDINGS)
    fill(cells, tracks.x, count, scale)
    at = np.empty(trees.shape[0], np.int64)
    for k in range(trees.shape[0]):
        t = at[k] = _likeliest(tracks, taken, cells, scale, axis[trees[k], 0], axis[trees[k], 1])
        if t >= 0:
            taken[t] = True
            if tracks.hits[t] > 0:
                tracks.verdict[t] = TREE
    undetected = cells_for(axis.shape[0])
    for known in (True, False):
        for k in range(trees.shape[0]):
            t, c = at[k], trees[k]
            x, y = axis[c, 0], axis[c, 1]
            if (t >= 0 and tracks.hits[t] > 0) or (t >= 0 and was_tree[t]) != known:
                continue
            stem = _detected_stem_near(tracks, cells, scale, x, y, fewest)
            if stem >= 0:
                tracks.verdict[stem] = TREE
            elif nearest_in(undetected, axis, x, y, SHARED_SURROUNDINGS, scale) < 0:
                put_in(undetected, axis, c, scale)
                if t < 0:
                    new[n] = c
                    n += 1
                    continue
                tracks.verdict[t] = TREE
                tracks.x[t, 0], tracks.x[t, 1] = x, y
    found: Int = new[:n].copy()
    return found


@compiled_borrowing
def _detected_stem_near(tracks: Rows, cells: Cells, scale: float, x: float, y: float, fewest: int) -> int:
    """Return the row of the track with most detections near an axis, the lowest row of equal ones; -1 for
    none. It is a tree within SHARED_SURROUNDINGS, or has no class and is in the surroundings (RING_FAR).

    Args:
        tracks: The tracks.
        cells, scale: Grid of the tracks for searches within SHARED_SURROUNDINGS, and its cells per metre.
        x, y: Position of the axis [m].
        fewest: Minimum number of detections.
    """
    u, v = first_of_four(x, y, scale)
    best = np.int64(-1)
    for quarter in range(4):
        t = np.int64(cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))])
        while t >= 0:
            dx, dy = x - tracks.x[t, 0], y - tracks.x[t, 1]
            reach = RING_FAR if tracks.verdict[t] < 0 else SHARED_SURROUNDINGS
            if (
                dx * dx + dy * dy < reach * reach
                and tracks.hits[t] >= fewest
                and (tracks.verdict[t] < 0 or tracks.verdict[t] == TREE)
                and (
                    best < 0
                    or tracks.hits[t] > tracks.hits[best]
                    or (tracks.hits[t] == tracks.hits[best] and t < best)
                )
            ):
                best = t
            t = np.int64(cells.following[t])
    return int(best)


@compiled_borrowing
def _likeliest(tracks: Rows, taken: Bool, cells: Cells, scale: float, x: float, y: float) -> int:
    """Return the row of the track with the highest likelihood within REACH of an axis that is not in `taken`;
    -1 for none.

    The likelihood of a track with the distance d is (1 + hits) exp(-d^2 / (2 OWN^2)): each detection is of
    the trunk of the column with a probability that decreases with the distance. Of equal ones the lowest row
    is returned. Hits without the distance would prefer branches near a stem, which are observed as often.

    Args:
        tracks: The tracks.
        taken: Tracks that are left out, shape (T,).
        cells, scale: Grid of the tracks for searches within REACH at least, and its cells per metre.
        x, y: Position of the axis [m].
    """
    u, v = first_of_four(x, y, scale)
    most, best = 0.0, np.int64(-1)
    for quarter in range(4):
        t = np.int64(cells.head[cell_of(u + (quarter & 1), v + (quarter >> 1))])
        while t >= 0:
            dx, dy = x - tracks.x[t, 0], y - tracks.x[t, 1]
            square = dx * dx + dy * dy
            if not taken[t] and square < REACH * REACH:
                likely = (1.0 + tracks.hits[t]) * np.exp(-0.5 * square / (OWN * OWN))
                if likely > most or (likely == most and t < best):
                    most, best = likely, t
            t = np.int64(cells.following[t])
    return int(best)
