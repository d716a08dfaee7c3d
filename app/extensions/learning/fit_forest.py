"""Extension of a random forest with a few new examples, and the settings with which forests are fitted.

A forest is extended by structure expansion: it keeps its splits, and each leaf that new examples reach is
split further by them. The previous class shares of the leaf enter as PRIOR examples (Segev, Harel, Mannor,
Crammer, El-Yaniv, "Learn on source, refine on target: a model transfer learning framework with random
forests", 2017).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from app.extensions.learning.examples import POLE, TREE, UPRIGHT
from pipeline.classification.features import NAMES, RAYS
from pipeline.classification.forest import ALL_AROUND, CLASSES, FREE_END, ONE_WAY, ends_in_free_air
from pipeline.types.records import Bool, Float, Int

PRIOR = 3.0  # weight of the previous class shares of a leaf, in objects
LEAST = 2.0  # least weight of a new leaf, in objects
DEEPER = 4  # largest number of additional splits on a path


@dataclass(frozen=True, slots=True)
class ForestSettings:
    """Settings of the random forest for a kind of sensor.

    Attributes:
        figures: Share of the features that is tried at each split.
        tree: Weight of trees, chosen so that the same share of votes separates trees best for both kinds of
            sensor.
        upright: Weight of poles and persons, which are few and difficult.
        rays: Whether the features of rays are used.
    """

    figures: float
    tree: float
    upright: float
    rays: bool


# A sensor that looks one way sees a trunk from one side and no higher than its field of view; four real parks
# are too few to learn from rays.
SETTINGS = {
    ALL_AROUND: ForestSettings(0.3, tree=0.67, upright=2.0, rays=True),
    ONE_WAY: ForestSettings(0.3, tree=1.75, upright=1.0, rays=False),
}
# The forest that separates poles from trees that end in free air.
FREE_END_SETTINGS = ForestSettings(0.3, tree=1.0, upright=1.5, rays=False)


def class_weight(weight: Float, label: Int, settings: ForestSettings) -> Float:
    """Return the weights multiplied by the factor of their class, shape (N,).

    Args:
        weight: Weights, shape (N,).
        label: Index in CLASSES, shape (N,).
        settings: Settings with the factors `tree` for trees and `upright` for poles and persons; the factor
            of other classes is 1.
    """
    factor = np.where(label == TREE, settings.tree, 1.0)
    factor[np.isin(label, UPRIGHT)] = settings.upright
    return weight * factor


def of_free_end(figures: Float, label: Int) -> Bool:
    """Return which of N examples are poles or trees with a free upper end (`ends_in_free_air`), shape (N,).

    Args:
        figures: Features, shape (N, features).
        label: Index in CLASSES, shape (N,).
    """
    of: Bool = np.isin(label, (TREE, POLE)) & ends_in_free_air(figures)
    return of


def node_of(tree: Any, share: Float, row: int) -> dict[str, Any]:  # noqa: ANN401
    """Return a node of a tree of scikit-learn with all nodes below it as a dict of JSON values. A leaf has
    `share`, the list of the class shares in the order of CLASSES. A split has `figure`, the name of a
    feature, `at_most`, the threshold rounded to four decimals, and the nodes `yes` (feature at most the
    threshold) and `no`. A split with two equal leaves becomes a leaf.

    Args:
        tree: The tree.
        share: Class shares of all nodes, shape (nodes, classes).
        row: The node.
    """
    if tree.children_left[row] < 0:
        return {"share": [int(v) if v in (0.0, 1.0) else v for v in share[row].tolist()]}
    yes = node_of(tree, share, tree.children_left[row])
    no = node_of(tree, share, tree.children_right[row])
    if "share" in yes and yes == no:
        return yes
    threshold = round(float(tree.threshold[row]), 4)
    return {"figure": NAMES[tree.feature[row]], "at_most": threshold, "yes": yes, "no": no}


def all_expanded(
    base: dict[str, Any], kind: str, figures: Float, label: Int, thing: Int, seed: int
) -> dict[str, list[dict[str, Any]]]:
    """Return a dict from keys of the JSON of the random forest to lists of extended trees: `kind` and, for
    ONE_WAY, FREE_END if the forest has it; the trees of FREE_END are extended only with examples of
    `of_free_end`.

    Args:
        base: JSON of the random forest.
        kind: Kind of the sensor, a key of SETTINGS.
        figures, label, thing, seed: See `expanded`.
    """
    grown = {kind: expanded(base[kind], SETTINGS[kind], figures, label, thing, seed)}
    if kind == ONE_WAY and FREE_END in base:
        of = of_free_end(figures, label)
        grown[FREE_END] = expanded(base[FREE_END], FREE_END_SETTINGS, figures[of], label[of], thing[of], seed)
    return grown


def expanded(
    trees: list[dict[str, Any]], settings: ForestSettings, figures: Float, label: Int, thing: Int, seed: int
) -> list[dict[str, Any]]:
    """Return the extended trees of a random forest; the given trees are not modified. Leaves that no example
    reaches are unchanged.

    Args:
        trees: Root nodes of the trees, see `node_of`.
        settings: Settings with which they were trained.
        figures: Features, shape (N, features).
        label: Index in CLASSES, shape (N,).
        thing: Number of the object, shape (N,); each object has the same weight, for any number of examples.
        seed: Random seed.
    """
    _, of, number = np.unique(thing, return_inverse=True, return_counts=True)
    weight = class_weight(1.0 / number[of], label, settings)
    draws = np.random.default_rng(seed).integers(0, 2**31, len(trees))
    return [
        _expanded_node(tree, figures, label, weight, settings, draw)
        for tree, draw in zip(trees, draws.tolist(), strict=True)
    ]


def _expanded_node(
    node: dict[str, Any], figures: Float, label: Int, weight: Float, settings: ForestSettings, draw: int
) -> dict[str, Any]:
    """Return a node with its leaves extended by the examples that reach it; the argument if there are no
    examples.

    Args:
        node: Node, see `node_of`.
        figures, label: Features and classes of the examples that reach it, shapes (N, features) and (N,).
        weight: Weights of the examples, shape (N,).
        settings: Settings of the random forest.
        draw: Random seed of the tree.
    """
    if not len(label):
        return node
    if "share" in node:
        return _leaf(np.array(node["share"], np.float64), figures, label, weight, settings, draw)
    yes = figures[:, NAMES.index(node["figure"])] <= node["at_most"]
    return {
        **node,
        "yes": _expanded_node(node["yes"], figures[yes], label[yes], weight[yes], settings, draw),
        "no": _expanded_node(node["no"], figures[~yes], label[~yes], weight[~yes], settings, draw),
    }


def _leaf(
    share: Float, figures: Float, label: Int, weight: Float, settings: ForestSettings, draw: int
) -> dict[str, Any]:
    """Return the node (see `node_of`) that replaces a leaf: a leaf, or at most DEEPER levels of splits that
    separate trees from all other classes. The class shares of a new leaf are the mean of the previous shares,
    with weight PRIOR, and of its examples, rounded to two decimals.

    Args:
        share: Previous class shares, shape (classes,).
        figures, label, weight: The examples, at least one, see `_expanded_node`.
        settings: Settings of the random forest.
        draw: Random seed.
    """
    from sklearn.tree import DecisionTreeClassifier

    known = figures if settings.rays else figures[:, :RAYS]
    tree = DecisionTreeClassifier(
        max_depth=DEEPER,
        min_weight_fraction_leaf=min(LEAST / weight.sum(), 0.5),
        max_features=settings.figures,
        random_state=draw,
    ).fit(known.astype(np.float32), label == TREE, weight)
    leaf = tree.apply(known.astype(np.float32))
    counts = np.zeros((tree.tree_.node_count, len(CLASSES)))
    np.add.at(counts, (leaf, label), weight)
    mixed = (PRIOR * share + counts) / (PRIOR * share.sum() + counts.sum(axis=1, keepdims=True))
    return node_of(tree.tree_, np.round(mixed, 2), 0)
