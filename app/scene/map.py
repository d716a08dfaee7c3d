"""The tree map in the scene: one mesh for all trees, their numbers, and the ground truth as rings."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import viser
from numpy.typing import NDArray

from app.scene import colours, nodes
from app.scene.colours import ViewSettings
from app.scene.nodes import (
    MOST_LABELS,
    OWN_TREE,
    Batch,
    Circles,
    CloudNode,
    Float,
    GroundNode,
    Label,
    LabelNodes,
    Place,
    Segments,
    scan_in_map,
    short,
)
from pipeline.config.stages import Evaluation
from pipeline.evaluation import match
from pipeline.geometry.columns import GrowingColumns, rows_of
from pipeline.types.records import HIDDEN, Frame, HeightMap, Trees, TruthTrees

Ring = tuple[float, float, float] | None

TREE_HEIGHT = 2.2  # height of a drawn trunk of a drive [m]
BREAST_HEIGHT = 1.3  # height of a drawn trunk without a drive, where its circle is fitted [m]
UNKNOWN_RADIUS = 0.08  # radius of a drawn trunk whose diameter is unknown [m]


class MapNodes:
    """Nodes of trees and ground truth.

    Args:
        scene: Scene of viser to which the nodes are added.
        on_tree: Called in the thread of viser with the number of a clicked tree.

    Attributes:
        labelled: Positions x, y, z of the labels in the map [m].
    """

    def __init__(self, scene: viser.SceneApi, on_tree: Callable[[int], None]) -> None:
        self.ground = GroundNode(scene)
        self._trees = Batch(scene, "/world/trees", nodes.cylinder(), opacity=0.55)
        self._circles = Circles(scene, "/world/breast", BREAST_HEIGHT, 4.0)
        self._truth = Circles(scene, "/world/truth", 0.04, 2.5)
        self._mark = Circles(scene, "/world/selection", 0.06, 5.0)
        self._unseen = Segments(scene, "/world/unseen", 4.0)
        self._labels = LabelNodes(scene, "/world/numbers", 1.0)
        self._numbers: list[int] = []
        self._foot: Float = np.zeros(0)
        self._drawn: tuple[TruthTrees | None, HeightMap | None] = (None, None)  # ground truth and ground
        self.labelled: list[Place] = []

        @self._trees.node.on_click
        async def _(event: viser.SceneNodePointerEvent[Any]) -> None:
            numbers = self._numbers
            if event.instance_index is not None and 0 <= event.instance_index < len(numbers):
                on_tree(numbers[event.instance_index])

    def show(
        self, frame: Frame, selected: int | None, ring: Ring, view: ViewSettings, feet: TreeFeet
    ) -> None:
        """Show the map after a scan. Trees that move by less than a centimetre are not sent again;
        unconfirmed trees are not shown. Trees have labels if the layers of trees and labels are on;
        `labelled` has their positions afterwards.

        Args:
            frame: Results of the scan.
            selected: Number of the selected tree, or None.
            ring: x, y and radius of the selected cluster [m] in the frame of the map, or None.
            view: Visible layers.
            feet: Heights of the lowest points of the trees.
        """
        self.ground.show(view.layers["ground"], frame.ground)
        trees, pose = rows_of(frame.trees, frame.trees.confirmed), frame.estimate.T_map_base
        foot = feet.heights(frame, trees, self.ground)
        self._numbers, self._foot = trees.number.tolist(), foot
        self._show_trees(trees, np.round(foot, 1), frame.of_drive, view)
        self._show_mark(trees, foot, selected, ring, frame.base_z)
        robot = np.array([pose.x, pose.y])
        named = view.layers["trees"] and view.layers["labels"]
        labels = tree_labels(trees, robot, selected, foot) if named else []
        self._labels.show(labels)
        self.labelled = [label.place for label in labels]

    def place_of(self, frame: Frame, tree: int | None, ring: Ring) -> tuple[float, float, float] | None:
        """Return x, y and height of the ground [m] in the map of the selected cluster (`ring`), else of the
        selected tree. None if there is no `ring` and `tree` is no confirmed tree of the frame, which is the
        shown one. Other arguments as in `show`."""
        if ring is not None:
            return *ring[:2], float(self.ground.heights(np.array([ring[:2]]), frame.base_z)[0])
        if tree is None or tree not in self._numbers:
            return None
        row = self._numbers.index(tree)
        x, y = frame.trees.position[frame.trees.confirmed][row].tolist()
        return x, y, float(self._foot[row])

    def show_truth(self, trees: TruthTrees | None, view: ViewSettings) -> None:
        """Show rings at the objects of the ground truth, on the known ground, 12 cm outside their trunks;
        hidden for None, without objects, and while the layer is off. They are drawn again only for another
        table or another ground."""
        on = view.layers["truth"] and trees is not None and len(trees.x) > 0
        drawn = (trees, self.ground.shown)
        if trees is None or not on or (drawn[0] is self._drawn[0] and drawn[1] is self._drawn[1]):
            self._truth.update(on)
            return
        self._drawn = drawn
        radius = np.where(np.isfinite(trees.dbh), 0.5 * trees.dbh, UNKNOWN_RADIUS) + 0.12
        is_tree = np.array([kind == "tree" for kind in trees.kind], dtype=bool)
        place = np.column_stack([trees.x, trees.y])
        self._truth.show_at(
            True,
            place,
            radius,
            colours.choose(is_tree, colours.TRUTH, colours.OTHER),
            self.ground.heights(place, 0.0),
        )

    def _show_trees(self, trees: Trees, foot: Float, of_drive: bool, view: ViewSettings) -> None:
        """Send the trunks; without a drive they are as thick as their circles, which are drawn on their
        upper ends.

        Args:
            trees: Confirmed trees.
            foot: Height of the ground at each of them, shape (T,) [m].
            of_drive: Whether the map is of a drive.
            view: Visible layers.
        """
        measured = np.isfinite(trees.dbh)
        place = np.round(trees.position, 2)
        radius: Float = np.where(measured, 0.5 * trees.dbh, UNKNOWN_RADIUS).round(3)
        height = np.full(len(radius), TREE_HEIGHT if of_drive else BREAST_HEIGHT)
        each = colours.choose(measured, colours.TREE, colours.UNMEASURED)
        self._trees.show(
            view.layers["trees"],
            np.column_stack([place, foot]),
            np.column_stack([radius, radius, height]),
            each,
        )
        arcs = unseen_arcs(rows_of(trees, ~measured), foot[~measured])
        self._unseen.show(view.layers["trees"], arcs, colours.UNCERTAIN)
        on = view.layers["fits"] and not of_drive
        self._circles.show_at(on, place[measured], radius[measured], each[measured], foot[measured])

    def _show_mark(self, trees: Trees, foot: Float, selected: int | None, ring: Ring, base_z: float) -> None:
        """Show the ring of the selected cluster or, without one, a ring around the selected tree; none
        without a selection.

        Args:
            trees: Confirmed trees.
            foot: Height of the ground at each of them, shape (T,) [m].
            selected: Number of the selected tree, or None.
            ring: x, y and radius of the selected cluster [m], or None.
            base_z: Height of a cluster where the ground is unknown [m].
        """
        # Around a cluster there is its own ring; a second one around its tree would only cover it.
        row = trees.number == (-1 if selected is None or ring is not None else selected)
        places, radii, z = np.round(trees.position[row], 2), [], foot[row]
        for dbh in trees.dbh[row]:
            radii.append(0.4 + (0.5 * dbh if np.isfinite(dbh) else UNKNOWN_RADIUS))
        if ring is not None:
            places, radii = np.vstack([places, ring[:2]]), [*radii, ring[2] + 0.12]
            z = np.append(z, self.ground.heights(places[-1:], base_z))
        each = np.tile(np.array([colours.SELECTION], dtype=np.uint8), (len(radii), 1))
        self._mark.show_at(True, places, np.array(radii), each, z)


SECTORS = 36  # of `Trees.sides`
UNSEEN_RADIUS, UNSEEN_HEIGHT = 0.35, 0.05  # m, of the arcs around trees, above the ground


def unseen_arcs(trees: Trees, foot: Float) -> Float:
    """Return the sides from which trees were never seen as segments of rings at their feet, shape (S, 2, 3)
    [m]; none if only the coverage is known.

    Args:
        trees: The trees, shape (T,).
        foot: Height of the ground at each [m].
    """
    if trees.sides is None:
        return np.zeros((0, 2, 3))
    unseen = (trees.sides[:, None] >> np.arange(SECTORS) & 1) == 0
    row, side = np.nonzero(unseen)
    angle = 2.0 * np.pi / SECTORS * (side[:, None] + np.array([0.0, 1.0]))
    around = UNSEEN_RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    height = np.broadcast_to((foot[row] + UNSEEN_HEIGHT)[:, None, None], (len(row), 2, 1))
    return np.concatenate([np.round(trees.position[row], 2)[:, None] + around, height], axis=2)


class TreeFeet:
    """Heights of the feet of trees: that of the terrain, and where none is known there, of the lowest point
    of the tree in the scans that were shown before. Points of clusters count; a tree without any takes all
    points around it. When an earlier scan or other results of the same scan are shown, the heights of the
    scans before are discarded."""

    def __init__(self) -> None:
        self._frame: Frame | None = None  # of the last call
        # By number of the tree: its place, the height of that point, and whether it is of a cluster.
        self._lowest: dict[int, tuple[tuple[float, float], float, bool]] = {}

    def heights(self, frame: Frame, trees: Trees, ground: GroundNode) -> Float:
        """Return the height of the foot of each tree, shape (T,) [m]; without terrain and points that of the
        nearest other tree, and that of the base of the robot if no tree has one.

        Args:
            frame: Results of the scan.
            trees: Its confirmed trees.
            ground: Ground with its heights.
        """
        foot = ground.heights(trees.position, np.nan)
        unknown = np.isnan(foot)
        if unknown.any():
            if frame is not self._frame:
                self._add(frame, rows_of(trees, unknown))
            numbers = trees.number[unknown].tolist()
            foot[unknown] = [self._lowest.get(number, _NO_FOOT)[1] for number in numbers]
            known = np.isfinite(foot)
            if not known.any():
                return np.full(len(foot), frame.base_z)
            if known.all():
                return foot
            others = trees.position[known]
            nearest = [np.hypot(*(others - place).T).argmin() for place in trees.position[~known]]
            foot[~known] = foot[known][nearest]
        return foot

    def _add(self, frame: Frame, trees: Trees) -> None:
        """Add the points of a scan to the feet of trees."""
        if self._frame is not None and frame.index <= self._frame.index:
            self._lowest.clear()
        self._frame = frame
        for place, number in zip(trees.position, trees.number.tolist(), strict=True):
            # The same number is another tree after the run was mapped again.
            if number in self._lowest and math.dist(self._lowest[number][0], place) > OWN_TREE:
                del self._lowest[number]
        self._take(trees, scan_in_map(frame, frame.filtered[frame.labels >= 0]), clustered=True)
        is_clustered = [self._lowest.get(number, _NO_FOOT)[2] for number in trees.number.tolist()]
        if not all(is_clustered):
            self._take(
                rows_of(trees, ~np.array(is_clustered)), scan_in_map(frame, frame.raw), clustered=False
            )

    def _take(self, trees: Trees, points: NDArray[np.float32], *, clustered: bool) -> None:
        """Lower the feet to points in the map, shape (N, 3) [m], that are at most OWN_TREE from a tree."""
        row = nodes.nearest_within(trees.position, points[:, :2], OWN_TREE)
        low = np.full(len(trees.number), np.inf)
        np.minimum.at(low, row[row >= 0], points[row >= 0, 2])
        for k in np.flatnonzero(np.isfinite(low)).tolist():
            number, z, (x, y) = int(trees.number[k]), float(low[k]), trees.position[k].tolist()
            _, before, was_clustered = self._lowest.get(number, _NO_FOOT)
            is_same = math.isfinite(before) and was_clustered == clustered
            self._lowest[number] = (x, y), min(z, before) if is_same else z, clustered


_NO_FOOT = ((0.0, 0.0), math.nan, False)


def tree_labels(
    trees: Trees, robot: NDArray[np.float64], selected: int | None, foot: NDArray[np.float64]
) -> list[Label]:
    """Return at most MOST_LABELS labels in the frame of the map: for the selected tree, then for other trees
    from near to far from the robot.

    Args:
        trees: Trees of the map; they need not be confirmed.
        robot: Position x, y of the robot in the map, shape (2,) [m].
        selected: Number of the selected tree, or None.
        foot: Height of the ground at each tree, shape (T,) [m].
    """
    distance = np.linalg.norm(trees.position - robot, axis=1)
    order = np.lexsort((distance, trees.number != (-1 if selected is None else selected)))
    places = np.column_stack([trees.position, np.round(foot, 1) + TREE_HEIGHT + 0.15])
    return [
        Label(
            int(trees.number[row]),
            _tree_text(trees, row, int(trees.number[row]) == selected),
            tuple(places[row].tolist()),
        )
        for row in order[:MOST_LABELS].tolist()
    ]


def _tree_text(trees: Trees, row: int, selected: bool) -> str:
    """Return the label of a tree: number, DBH and eccentricity as in "7: 24 cm, e 3.8", "7: e 3.8" without a
    DBH, and "7" without both; of the selected one "tree 7, DBH 24.1 cm, e 3.8" or "tree 7, DBH not measured,
    e 3.8".

    Args:
        trees: Trees of the map.
        row: Row of the tree.
        selected: Whether it is selected.
    """
    number, dbh = int(trees.number[row]), float(trees.dbh[row])
    eccentricity = float(trees.eccentricity[row])
    figures = [] if np.isnan(eccentricity) else [f"e {short(eccentricity)}"]
    if np.isfinite(dbh):
        figures.insert(0, f"{100 * dbh:.1f} cm" if selected else f"{100 * dbh:.0f} cm")
    elif selected:
        figures.insert(0, "not measured")
    if selected:
        return f"tree {number}, DBH {', '.join(figures)}"
    return f"{number}: {', '.join(figures)}" if figures else f"{number}"


TIMES = 10.0  # magnification of position errors, which are centimetres
CROSS = 0.45  # half the width of the cross of a missed tree [m]
AROUND = 0.6  # radius of the ring of a false tree [m]
HEIGHT = 0.08  # above the ground [m]


class ErrorNode(Segments):
    """Errors of the map against the ground truth, as lines: offsets, missed trees and false trees.

    Attributes:
        count: Number of missed and false trees that are shown; 0 while hidden.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene, "/world/errors", 3.0)
        self.count = 0

    def show_errors(
        self,
        on: bool,
        frame: Frame,
        truth: TruthTrees | None,
        path: Float,
        wanted: Evaluation,
        ground: GroundNode,
    ) -> None:
        """Show the errors of the map against the ground truth.

        Args:
            on: Whether the layer is on; otherwise nothing is computed.
            frame: Results of the scan with the map.
            truth: Ground truth; None hides the errors.
            path: Positions of the robot, shape (N, 2) [m]; the ground truth within reach of them counts. An
                empty path hides the errors.
            wanted: Distances of a match and of the ground truth from the path.
            ground: Ground with its heights.
        """
        if not on or truth is None or len(path) == 0:
            self.count = 0
            self.update(False)
            return
        offsets, missed, false = errors(frame.trees, truth, path, wanted)
        self.count = len(missed) + len(false)
        lines: list[NDArray[np.floating]] = [
            np.stack([offsets[:, 0], offsets[:, 0] + TIMES * (offsets[:, 1] - offsets[:, 0])], axis=1),
            _crosses(missed),
            nodes.circles(false, np.full(len(false), AROUND), np.zeros(len(false)))[:, :, :2],
        ]
        flat = np.concatenate(lines).reshape(-1, 2)
        xyz = np.column_stack([flat, ground.heights(flat, 0.0) + HEIGHT]).reshape(-1, 2, 3)
        each = np.array([colours.SELECTION, colours.ERROR, colours.ERROR], dtype=np.uint8)
        self.show(True, xyz, np.repeat(each, [len(part) for part in lines], axis=0))


def errors(trees: Trees, truth: TruthTrees, path: Float, wanted: Evaluation) -> tuple[Float, Float, Float]:
    """Return the errors of a map as positions x, y in the map [m]: pairs of true and mapped position of
    matched trees, shape (M, 2, 2); true positions of missed trees, shape (K, 2); and mapped positions of
    false trees, shape (F, 2).

    Args:
        trees: The map; confirmed trees count. One that is matched with another object is false, and one that
            is matched with a HIDDEN tree neither right nor false, as in the scores.
        truth: Ground truth.
        path: Positions of the robot, shape (N, 2) [m], N >= 1. Only trees within reach of it count as missed
            or false; matched trees may be farther away.
        wanted: Distances of a match and of the ground truth from the path.
    """
    true, kind = np.column_stack([truth.x, truth.y]), np.array(truth.kind, np.str_)
    confirmed = np.flatnonzero(trees.confirmed)
    truth_of = match(trees.position[confirmed], true, wanted.match_distance)
    rows, truth_of = confirmed[truth_of >= 0], truth_of[truth_of >= 0]
    is_tree = kind[truth_of] == "tree"
    offsets = np.stack([true[truth_of[is_tree]], trees.position[rows[is_tree]]], axis=1)
    from scipy.spatial import cKDTree

    way = cKDTree(path)
    missed = kind == "tree"
    missed[truth_of] = False
    false = trees.confirmed.copy()
    false[rows[is_tree | (kind[truth_of] == HIDDEN)]] = False
    left_out, wrong = true[missed], trees.position[false]
    return offsets, left_out[_near(way, left_out, wanted.reach)], wrong[_near(way, wrong, wanted.reach)]


def _near(way: object, places: Float, reach: float) -> NDArray[np.bool_]:
    """Return which positions are within `reach` of the path, shape (N,).

    Args:
        way: KD-tree of the path.
        places: Positions, shape (N, 2) [m].
        reach: Maximum distance [m].
    """
    if not len(places):
        return np.zeros(0, np.bool_)
    distance: Float = way.query(places)[0]  # type: ignore[attr-defined]
    return distance <= reach


def _crosses(places: Float) -> Float:
    """Return two diagonal segments, each from corner to corner of a square with side 2 CROSS, around each of
    N positions, shape (N, 2) [m], as shape (2 N, 2, 2) [m]."""
    arms = CROSS * np.array([[[-1.0, -1.0], [1.0, 1.0]], [[-1.0, 1.0], [1.0, -1.0]]])
    return (places[:, None, None, :] + arms).reshape(-1, 2, 2)


SIDE = 0.1  # initial side of a cell, which is shown as one point [m]
MOST_POINTS = 200_000
MOST_RECENT = 400_000  # points of the scans that are kept for the time windows
RECENT_STEP_NS = 200_000_000  # between two of these scans [ns]
BLOCK = 20_000  # points per node, so that a large map is not sent again with each scan
STEP, TURN = 0.25, 0.17  # motion after which the next scan is added [m, rad]
LOW, HIGH = 0.0, 3.0  # heights at the ends of the colour ramp [m]
_HALF = 1 << 20  # largest cell coordinate of a key


class Accumulated:
    """Filtered points of all scans in the frame of the map, one per cell, placed by the pose of their scan.
    The side of the cells doubles where there would be more than MOST_POINTS points."""

    def __init__(self) -> None:
        self._side = SIDE
        self._recent: list[_PlacedScan] = []
        self._rows = GrowingColumns(np.zeros((0, 3), np.float32), np.zeros(0, np.int64))  # points, cells
        # Columns, not objects: each scan of a long drive adds a row. Scan, points before it, pose.
        self._scans = GrowingColumns(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))

    @property
    def points(self) -> NDArray[np.float32]:
        """The points, float32, shape (N, 3) [m], in order of arrival; later calls do not change them."""
        points: NDArray[np.float32] = self._rows.shared()[0]
        return points

    def take(self, frame: Frame) -> bool:
        """Add the filtered points of a scan; if the run went back, remove those of this and later scans
        first.

        Nothing is added to `points` if the robot moved less than STEP and turned less than TURN since the
        last added scan. Only the first point of each cell is kept. The time windows of `points_of` do not
        depend on the motion.

        Returns:
            Whether `points` changed.
        """
        went_back = self._go_back(frame.index)
        placed = _placed(frame)
        self._keep_recent(frame, placed)
        pose = frame.estimate.T_map_base.as_array()
        scans, before, poses = (self._scans.column(k) for k in range(3))
        if len(scans):
            moved = pose - poses[-1]
            turned = abs((moved[2] + np.pi) % (2.0 * np.pi) - np.pi)
            if np.hypot(*moved[:2]) < STEP and turned < TURN:
                return went_back
        keys, first = np.unique(_keys(placed, self._side), return_index=True)
        count = len(self._rows)
        new = np.sort(first[~np.isin(keys, self._rows.column(1))])
        row = len(scans)
        if row and before[-1] == count:
            row -= 1  # it added no point, and only the last such scan is needed, for its pose
        self._scans.write(row, np.array([frame.index]), np.array([count]), pose[None])
        self._rows.write(count, placed[new].astype(np.float32), _keys(placed[new], self._side))
        while len(self._rows) > MOST_POINTS:
            self._double_side()
        return went_back or len(new) > 0

    def _double_side(self) -> None:
        """Double the side of the cells; of each larger cell the first point is kept."""
        self._side *= 2.0
        points = self._rows.column(0)
        keys = _keys(points, self._side)
        kept = np.sort(np.unique(keys, return_index=True)[1])
        scans, before, poses = (self._scans.column(k) for k in range(3))
        self._scans.write(0, scans, np.searchsorted(kept, before), poses)
        self._rows.write(0, points[kept], keys[kept])

    def points_of(self, window: str) -> NDArray[np.float32]:
        """Return the points that the layer shows in the frame of the map, float32, shape (N, 3) [m], one per
        cell: `points` itself for the whole run, else the points of the kept scans within the time window
        before the last one, placed by the pose that each scan had when it was added.

        Args:
            window: A key of colours.WINDOWS.
        """
        seconds = colours.WINDOWS[window]
        if seconds is None or not self._recent:
            return self.points
        start = self._recent[-1].stamp_ns - round(1e9 * seconds)
        points = np.concatenate([each.points for each in self._recent if each.stamp_ns >= start])
        first = np.unique(_keys(points, SIDE), return_index=True)[1]
        return points[np.sort(first)]

    def _keep_recent(self, frame: Frame, placed: NDArray[np.float64]) -> None:
        """Keep the points of a scan for `points_of`, unless the last kept scan was less than RECENT_STEP_NS
        before; the oldest scans go once there are more than MOST_RECENT points."""
        while self._recent and self._recent[-1].scan >= frame.index:
            self._recent.pop()
        if self._recent and frame.stamp_ns - self._recent[-1].stamp_ns < RECENT_STEP_NS:
            return
        self._recent.append(_PlacedScan(frame.index, frame.stamp_ns, placed.astype(np.float32)))
        while len(self._recent) > 1 and sum(len(each.points) for each in self._recent) > MOST_RECENT:
            del self._recent[0]

    def _go_back(self, index: int) -> bool:
        """Remove the points of the scan with this index and of later ones; return whether there were any."""
        scans = self._scans.column(0)
        row = int(np.searchsorted(scans, index))
        if row == len(scans):
            return False
        self._rows.return_to(int(self._scans.column(1)[row]))
        self._scans.return_to(row)
        return True


class _PlacedScan(NamedTuple):
    """The filtered points of a scan in the frame of the map, float32, shape (N, 3) [m]."""

    scan: int
    stamp_ns: int
    points: NDArray[np.float32]


def _placed(frame: Frame) -> NDArray[np.float64]:
    """Return the filtered points of a scan in the frame of the map by its pose, shape (N, 3) [m]."""
    points = frame.filtered + frame.sensor_offset.astype(np.float32)
    return np.column_stack(
        [frame.estimate.T_map_base.apply(points[:, :2].astype(np.float64)), points[:, 2] + frame.base_z]
    )


class MapCloud:
    """The accumulated points in the scene, in blocks.

    Args:
        scene: Scene of viser to which the nodes are added.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._blocks: list[CloudNode] = []

    def show(self, on: bool, points: NDArray[np.float32]) -> None:
        """Show points, shape (N, 3) [m], coloured by height, or hide them (`on` False); only blocks that
        changed are sent."""
        while on and len(self._blocks) * BLOCK < len(points):
            self._blocks.append(CloudNode(self._scene, f"/world/gathered/{len(self._blocks)}", 0.05))
        for number, block in enumerate(self._blocks):
            part = points[number * BLOCK : (number + 1) * BLOCK] if on else points[:0]
            block.show(on, part, colours.ramp(part[:, 2], LOW, HIGH))


def _keys(points: NDArray[np.floating], side: float) -> NDArray[np.int64]:
    """Return the key of the cell of each point, shape (N,), for points of shape (N, 3) and cells with this
    side [m]. Coordinates beyond 2^20 sides (105 km for SIDE) share the outermost cells."""
    cell = (
        np.clip(np.floor(np.asarray(points, np.float64) / side), -_HALF, _HALF - 1).astype(np.int64) + _HALF
    )
    keys: NDArray[np.int64] = (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]
    return keys
