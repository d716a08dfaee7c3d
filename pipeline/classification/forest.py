"""Random forests as columns, read from JSON and evaluated by compiled code, and the effect of single
features."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pipeline.classification.column_extraction import BUCKET
from pipeline.classification.features import NAMES
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import CLASSES as CLASSES
from pipeline.types.records import Bool, Int32, Verdict

ALL_AROUND, ONE_WAY = "all around", "one way"
FREE_END = "one way, ends in free air"  # key of the forest that separates trees from poles with a free end
PACKAGE = "package"  # name of the forest of the package
MOVED = BUCKET  # m; the features describe a column and its surroundings up to this distance
FILE = Path(__file__).with_name("forest.json")
_MOST_BYTES = 4_000_000
_MOST_NODES = 100_000

_TREE, _POLE = CLASSES.index(Verdict.TREE), CLASSES.index(Verdict.POLE)
_TOP, _FREE = NAMES.index("highest return"), NAMES.index("free above the highest return")
_TALL, _SEEN_FREE = 2.0 - 1e-6, 1.0 - 1e-6  # m; least height of a free end, and least free height above it

TREE_IN_FREE_AIR = 0.5  # columns with a smaller share of `free_end` are poles

_Row = tuple[int, float, int, int, list[float]]


class DecisionTrees(NamedTuple):
    """Nodes of all trees of a forest as columns of length N.

    Attributes:
        root: First node of each tree, int32, shape (T,).
        feature: Index of the feature, -1 at a leaf, int32.
        threshold: Threshold of the feature. Values up to it continue at the node `left`, others and NaN at
            the node `right` (both int32).
        share: Class shares of the training examples of a leaf, shape (N, classes).
    """

    root: Int32
    feature: Int32
    threshold: Float
    left: Int32
    right: Int32
    share: Float


@dataclass(frozen=True, slots=True, eq=False)
class Forest:
    """A random forest.

    Attributes:
        trees: Decision trees of the forest.
        free_end: Forest that decides whether a tree with a free upper end is a pole; None if there is none.
    """

    trees: DecisionTrees
    free_end: Forest | None = None


# Returns a forest by its name (parameter `classification.forest`) and by `is_seen_all_around`.
ForestOf = Callable[[str, bool], Forest]


def is_seen_all_around(rings: int, xy: Float) -> bool:
    """Return whether the random forest for sensors that see all around classifies the columns of a run: the
    sensor has rings, or the extent of the positions along x or y exceeds MOVED.

    Args:
        rings: Rings of the sensor; 0 for a sensor that looks one way.
        xy: Positions of the robot in the map so far, shape (N, 2) [m].
    """
    return rings > 0 or (len(xy) > 0 and bool((np.ptp(xy, axis=0) > MOVED).any()))


def package_alone(name: str, all_around: bool) -> Forest:
    """Return the random forest of the package for runs with `is_seen_all_around`, or for the others.

    Raises:
        StemmapError: The name is not PACKAGE, or the file cannot be read.
    """
    if name != PACKAGE:
        raise StemmapError(f"the decision trees {name} are not known here")
    return standard_forest(all_around)


@cache
def standard_forest(all_around: bool) -> Forest:
    """Return the random forest of the package for runs with `is_seen_all_around`, or for the others. The file
    is read once per process.

    Raises:
        StemmapError: The file is missing or damaged.
    """
    return read_forest(FILE, ALL_AROUND if all_around else ONE_WAY)


def read_forest(path: Path, kind: str) -> Forest:
    """Return a random forest of a JSON file for a kind of sensor, ALL_AROUND or ONE_WAY.

    Raises:
        StemmapError: The file is missing, larger than 4 MB, not the JSON of a forest, without this kind,
            trained for other classes, or names unknown features.
    """
    return read_forests(path, kind)[1][0]


def read_forests(path: Path, *kinds: str) -> tuple[dict[str, Any], list[Forest]]:
    """Return the JSON of a file as a dict, and a list of the random forests for the kinds of sensors `kinds`,
    in their order.

    Raises:
        StemmapError: The file is missing, larger than 4 MB, not the JSON of a forest, without one of the
            kinds, trained for other classes, or names unknown features.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError("it is too large")
        data = json.loads(path.read_text(encoding="utf-8"))
        return data, [forest_of(data, kind) for kind in kinds]
    except OSError as error:
        raise _damaged(path, str(error.strerror)) from None
    except (ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError) as error:
        raise _damaged(path, str(error)) from None


def _damaged(path: Path, why: str) -> StemmapError:
    """Return the error for a file of decision trees that cannot be read; `why` is the reason."""
    return StemmapError(
        f"the decision trees cannot be read: {why}",
        where=str(path),
        remedy="Restore the file of the package: install stemmap again",
    )


def forest_of(data: dict[str, Any], kind: str) -> Forest:
    """Return the forest of a JSON for a kind of sensor; for ONE_WAY with the forest of FREE_END, which
    earlier files do not have.

    Args:
        data: JSON object: "classes" is the list of the labels of CLASSES, and each kind is a list of trees of
            nested nodes (see `_lay_out`).
        kind: ALL_AROUND, ONE_WAY or FREE_END.

    Raises:
        ValueError, TypeError, KeyError, RecursionError: The JSON is not that of a forest, or has other
            classes, no tree, or more than 100,000 nodes.
    """
    if data["classes"] != [verdict.label for verdict in CLASSES]:
        raise ValueError("it was trained for other classes")
    rows: list[_Row] = []
    roots = [_lay_out(tree, rows) for tree in data[kind]]
    if not roots:
        raise ValueError("it has no trees")
    feature, threshold, left, right, share = zip(*rows, strict=True)
    trees = DecisionTrees(
        np.array(roots, np.int32),
        np.array(feature, np.int32),
        np.array(threshold, np.float64),
        np.array(left, np.int32),
        np.array(right, np.int32),
        np.array(share, np.float64),
    )
    return Forest(trees, forest_of(data, FREE_END) if kind == ONE_WAY and FREE_END in data else None)


def _lay_out(node: dict[str, Any], rows: list[_Row]) -> int:
    """Append a node and the nodes below it to `rows`, in place; return the row of the node.

    Args:
        node: JSON of a leaf ("share") or of a split ("figure", "at_most", "yes", "no").
        rows: Feature (-1 for a leaf), threshold, left, right, shares of each node so far.

    Raises:
        ValueError, TypeError, KeyError: The node is damaged, names an unknown feature, or there are more than
            100,000 nodes.
    """
    row, nothing = len(rows), [0.0] * len(CLASSES)
    if row >= _MOST_NODES:
        raise ValueError("it has too many nodes")
    if "share" in node:
        share = [float(v) for v in node["share"]]
        if len(share) != len(CLASSES) or not all(0.0 <= v <= 1.0 for v in share):
            raise ValueError("the shares of a leaf do not fit the classes")
        rows.append((-1, 0.0, row, row, share))
        return row
    feature, threshold = NAMES.index(node["figure"]), float(node["at_most"])
    rows.append((feature, threshold, row, row, nothing))
    left, right = _lay_out(node["yes"], rows), _lay_out(node["no"], rows)
    rows[row] = (feature, threshold, left, right, nothing)
    return row


def vote(figures: Float, forest: Forest) -> Float:
    """Return the shares of the votes in the order of CLASSES, mean over the decision trees, shape (K, 6).
    `figures` are the features of the columns in the order of NAMES, shape (K, COUNT).

    For columns with a free upper end whose share `tree_in_free_air` is below TREE_IN_FREE_AIR, the votes for
    tree are added to those for pole.
    """
    votes = _vote(figures, forest.trees)
    poles = np.flatnonzero(tree_in_free_air(figures, forest) < TREE_IN_FREE_AIR)
    votes[poles, _POLE] += votes[poles, _TREE]
    votes[poles, _TREE] = 0.0
    return votes


def tree_in_free_air(figures: Float, forest: Forest) -> Float:
    """Return the share of `free_end` for a tree, shape (K,); NaN for columns without a free end and if the
    forest has no `free_end`. `figures` has the shape (K, COUNT)."""
    share = np.full(len(figures), np.nan)
    if forest.free_end is not None:
        ends = ends_in_free_air(figures)
        share[ends] = vote(figures[ends], forest.free_end)[:, _TREE]
    return share


def ends_in_free_air(figures: Float) -> Bool:
    """Return which columns of sufficient height (2 m) have a free upper end, above which rays passed for 1 m,
    shape (K,). `figures` has the shape (K, COUNT)."""
    ends: Bool = (figures[:, _TOP] >= _TALL) & (figures[:, _FREE] >= _SEEN_FREE)
    return ends


@compiled
def _vote(figures: Float, trees: DecisionTrees) -> Float:
    """Return the mean class shares of the leaves that columns reach, shape (K, classes); `figures` has the
    shape (K, COUNT). A NaN counts as above each threshold."""
    root, feature, threshold, left, right, share = trees
    votes = np.zeros((figures.shape[0], share.shape[1]))
    for k in range(figures.shape[0]):
        for t in range(root.shape[0]):
            node = root[t]
            while feature[node] >= 0:
                node = left[node] if figures[k, feature[node]] <= threshold[node] else right[node]
            for c in range(share.shape[1]):
                votes[k, c] += share[node, c] / root.shape[0]
    return votes


_DEEPEST = 1024  # levels of a tree; training allows far less


def feature_effects(figures: Float, forest: Forest, kind: Verdict) -> Float:
    """Return by how much each feature of a column raises the share of votes for a class.

    The effect of a feature is the share of votes minus the share when the feature is unknown, where both
    branches of each split on it count by half. The forest `free_end` is not considered.

    Args:
        figures: Features of one column in the order of NAMES, shape (F,).
        forest: The forest.
        kind: One of CLASSES (ValueError for another verdict).

    Returns:
        Effects between -1 and 1, shape (F,); 0 for features that no tree uses for this column.
    """
    return _feature_effects(figures, forest.trees, CLASSES.index(kind))


@compiled
def _feature_effects(figures: Float, trees: DecisionTrees, kind: int) -> Float:
    """Return by how much each feature raises the share of votes for the class with the index `kind` in
    CLASSES, see `feature_effects`, shape (F,); `figures` are the features of one column, shape (F,)."""
    effects = np.zeros(figures.shape[0])
    for root in trees.root:
        known = _share(figures, -2, root, trees, kind)
        for f in range(figures.shape[0]):
            effects[f] += (known - _share(figures, f, root, trees, kind)) / trees.root.shape[0]
    return effects


@compiled
def _share(figures: Float, unknown: int, root: int | np.int32, trees: DecisionTrees, kind: int) -> float:
    """Return the share of a class at the leaf that a column reaches in one tree, averaged over both branches
    of each split on the unknown feature.

    Args:
        figures: Features of a column, shape (F,).
        unknown: Index of the feature that counts as unknown; negative for none.
        root: Row of the root of the tree.
        trees: The trees.
        kind: Index of the class in CLASSES.
    """
    _, feature, threshold, left, right, share = trees
    waiting, weight = np.empty(_DEEPEST, np.int64), np.empty(_DEEPEST)
    waiting[0], weight[0] = root, 1.0
    n, total = 1, 0.0
    while n > 0:
        n -= 1
        node, w = waiting[n], weight[n]
        while feature[node] >= 0:
            if feature[node] == unknown and n < _DEEPEST:
                w *= 0.5
                waiting[n], weight[n] = right[node], w
                n += 1
                node = left[node]
            else:
                node = left[node] if figures[feature[node]] <= threshold[node] else right[node]
        total += w * share[node, kind]
    return total
