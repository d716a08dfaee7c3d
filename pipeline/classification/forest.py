"""A few small decision trees as columns, read from JSON and walked in compiled code."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.classification.features import NAMES
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from pipeline.jit import compiled
from pipeline.types.records import CLASSES as CLASSES
from pipeline.types.records import Bool, Int32, Verdict

ALL_AROUND, ONE_WAY = "all around", "one way"
FREE_END = "one way, ends in free air"  # trees that tell what ends there from a pole
PACKAGE = "package"  # the name of the trees that come with the package
FILE = Path(__file__).with_name("forest.json")
_MOST_BYTES = 4_000_000
_MOST_NODES = 100_000

_TREE, _POLE = CLASSES.index(Verdict.TREE), CLASSES.index(Verdict.POLE)
_TOP, _FREE = NAMES.index("highest return"), NAMES.index("free above the highest return")
_TALL, _SEEN_FREE = 2.0 - 1e-6, 1.0 - 1e-6  # m; so high is what ends in free air, so much of it was seen

TREE_IN_FREE_AIR = 0.5  # with a smaller share of `free_end` it is a pole

_Row = tuple[int, float, int, int, list[float]]


@dataclass(frozen=True, slots=True, eq=False)
class Forest:
    """Nodes of all trees as columns of length N.

    Attributes:
        root: int32, shape (T,): the first node of each tree.
        feature: int32: which figure is asked for, -1 at a leaf.
        threshold: At most this goes to `left`, more to `right` (int32, nodes).
        share: shape (N, classes): at a leaf the shares of the kinds among what it was trained on.
        free_end: Asked whether a tree that ends in free air is a pole; None: nobody is asked.
    """

    root: Int32
    feature: Int32
    threshold: Float
    left: Int32
    right: Int32
    share: Float
    free_end: Forest | None = None


# By a name, as the parameter `gathering.forest` gives it, and whether the sensor sees all around.
ForestOf = Callable[[str, bool], Forest]


def package_alone(name: str, all_around: bool) -> Forest:
    """The forest of the package; it knows no other.

    Raises:
        StemmapError: Another one is asked for.
    """
    if name != PACKAGE:
        raise StemmapError(f"the decision trees {name} are not known here")
    return standard_forest(all_around)


@cache
def standard_forest(all_around: bool) -> Forest:
    """The forest that comes with the package for sensors that see all around, or for those that look one
    way: what these see of a trunk differs too much for one to serve both."""
    return read_forest(FILE, ALL_AROUND if all_around else ONE_WAY)


def read_forest(path: Path, kind: str) -> Forest:
    """Read a forest for a kind of sensor, ALL_AROUND or ONE_WAY.

    Raises:
        StemmapError: The file is too large, is no such JSON, or asks for figures that do not exist.
    """
    return read_forests(path, kind)[1][0]


def read_forests(path: Path, *kinds: str) -> tuple[dict[str, Any], list[Forest]]:
    """What a file of decision trees holds, and the forests for some kinds of sensors.

    Raises:
        StemmapError: As `read_forest`.
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
    return StemmapError(
        f"the decision trees cannot be read: {why}", where=str(path), remedy="`stemmap train` makes them anew"
    )


def forest_of(data: dict[str, Any], kind: str) -> Forest:
    """The forest for a kind of sensor out of what JSON holds, for one that looks one way with the trees of
    FREE_END where there are any: forests of before have none.

    Raises:
        ValueError, TypeError, KeyError: It holds something else.
    """
    if data["classes"] != [verdict.label for verdict in CLASSES]:
        raise ValueError("it was trained for other classes")
    rows: list[_Row] = []
    roots = [_lay_out(tree, rows) for tree in data[kind]]
    if not roots:
        raise ValueError("it has no trees")
    feature, threshold, left, right, share = zip(*rows, strict=True)
    return Forest(
        np.array(roots, np.int32),
        np.array(feature, np.int32),
        np.array(threshold, np.float64),
        np.array(left, np.int32),
        np.array(right, np.int32),
        np.array(share, np.float64),
        forest_of(data, FREE_END) if kind == ONE_WAY and FREE_END in data else None,
    )


def _lay_out(node: dict[str, Any], rows: list[_Row]) -> int:
    """Append a node and what hangs below it; returns its row."""
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
    """Shares of the kinds in the order of CLASSES, mean over the trees, shape (K, figures) -> (K, 6).

    Of what ends in free air the votes for a tree are a pole's where `free_end` says so: beside all else that
    is no tree poles are too few to be learned (docs/trunks.md).
    """
    f = forest
    votes = _vote(figures, f.root, f.feature, f.threshold, f.left, f.right, f.share)
    poles = np.flatnonzero(tree_in_free_air(figures, forest) < TREE_IN_FREE_AIR)
    votes[poles, _POLE] += votes[poles, _TREE]
    votes[poles, _TREE] = 0.0
    return votes


def tree_in_free_air(figures: Float, forest: Forest) -> Float:
    """The share of `free_end` for a tree, of what ends in free air, shape (K,); NaN of all else, and where
    nobody is asked."""
    share = np.full(len(figures), np.nan)
    if forest.free_end is not None:
        ends = ends_in_free_air(figures)
        share[ends] = vote(figures[ends], forest.free_end)[:, _TREE]
    return share


def ends_in_free_air(figures: Float) -> Bool:
    """Columns above whose highest return, that of a thing of some height, rays went on, shape (K,)."""
    ends: Bool = (figures[:, _TOP] >= _TALL) & (figures[:, _FREE] >= _SEEN_FREE)
    return ends


@compiled
def _vote(
    figures: Float, root: Int32, feature: Int32, threshold: Float, left: Int32, right: Int32, share: Float
) -> Float:
    votes = np.zeros((figures.shape[0], share.shape[1]))
    for k in range(figures.shape[0]):
        for t in range(root.shape[0]):
            node = root[t]
            while feature[node] >= 0:
                node = left[node] if figures[k, feature[node]] <= threshold[node] else right[node]
            for c in range(share.shape[1]):
                votes[k, c] += share[node, c] / root.shape[0]
    return votes
