"""Structure expansion: extends the trees of a random forest with a few new examples.

The forest keeps its splits. Each leaf that new examples reach is split further by them; its previous class
shares enter as PRIOR examples (Segev, Harel, Mannor, Crammer, El-Yaniv, "Learn on source, refine on target: a
model transfer learning framework with random forests", 2017).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from app.training.fit_forest import FREE_END_PLAN, PLANS, TREE, UPRIGHT, Plan, node_of, of_free_end
from pipeline.classification.features import NAMES, RAYS
from pipeline.classification.forest import CLASSES, FREE_END, ONE_WAY
from pipeline.types.records import Float, Int

PRIOR = 3.0  # weight of the previous class shares of a leaf, in objects
LEAST = 2.0  # least weight of a new leaf, in objects
DEEPER = 4  # largest number of additional splits on a path


def all_expanded(
    base: dict[str, Any], kind: str, figures: Float, label: Int, thing: Int, seed: int
) -> dict[str, list[dict[str, Any]]]:
    """Return the extended trees for a kind of sensor, by their key in the JSON. For sensors that look one way
    these include the trees for columns with a free upper end, which would overrule the others.

    Args:
        base: JSON of the forest.
        kind: Kind of the sensor, a key of PLANS.
        figures, label, thing, seed: See `expanded`.
    """
    grown = {kind: expanded(base[kind], PLANS[kind], figures, label, thing, seed)}
    if kind == ONE_WAY and FREE_END in base:
        of = of_free_end(figures, label)
        grown[FREE_END] = expanded(base[FREE_END], FREE_END_PLAN, figures[of], label[of], thing[of], seed)
    return grown


def expanded(
    trees: list[dict[str, Any]], plan: Plan, figures: Float, label: Int, thing: Int, seed: int
) -> list[dict[str, Any]]:
    """Return the extended trees of a forest.

    Args:
        trees: Trees as in the JSON.
        plan: Settings with which they were trained.
        figures: Features, shape (N, features).
        label: Index in CLASSES, shape (N,).
        thing: Number of the object, shape (N,); each object has the same weight, for any number of examples.
        seed: Random seed.
    """
    _, of, number = np.unique(thing, return_inverse=True, return_counts=True)
    weight = 1.0 / number[of]
    weight[label == TREE] *= plan.tree
    weight[np.isin(label, UPRIGHT)] *= plan.upright
    draws = np.random.default_rng(seed).integers(0, 2**31, len(trees))
    return [
        _grown(tree, figures, label, weight, plan, draw)
        for tree, draw in zip(trees, draws.tolist(), strict=True)
    ]


def _grown(
    node: dict[str, Any], figures: Float, label: Int, weight: Float, plan: Plan, draw: int
) -> dict[str, Any]:
    if not len(label):
        return node
    if "share" in node:
        return _leaf(np.array(node["share"], np.float64), figures, label, weight, plan, draw)
    yes = figures[:, NAMES.index(node["figure"])] <= node["at_most"]
    return {
        **node,
        "yes": _grown(node["yes"], figures[yes], label[yes], weight[yes], plan, draw),
        "no": _grown(node["no"], figures[~yes], label[~yes], weight[~yes], plan, draw),
    }


def _leaf(share: Float, figures: Float, label: Int, weight: Float, plan: Plan, draw: int) -> dict[str, Any]:
    from sklearn.tree import DecisionTreeClassifier

    known = figures if plan.rays else figures[:, :RAYS]
    tree = DecisionTreeClassifier(
        max_depth=DEEPER,
        min_weight_fraction_leaf=min(LEAST / weight.sum(), 0.5),
        max_features=plan.figures,
        random_state=draw,
    ).fit(known.astype(np.float32), label == TREE, weight)
    leaf = tree.apply(known.astype(np.float32))
    said = np.zeros((tree.tree_.node_count, len(CLASSES)))
    np.add.at(said, (leaf, label), weight)
    mixed = (PRIOR * share + said) / (PRIOR * share.sum() + said.sum(axis=1, keepdims=True))
    return node_of(tree.tree_, np.round(mixed, 2), 0)
