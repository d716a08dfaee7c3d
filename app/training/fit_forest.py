"""Fitting of random forests to examples, as JSON, and extension of a forest with a few new examples.

A forest is extended by structure expansion: it keeps its splits, and each leaf that new examples reach is
split further by them. The previous class shares of the leaf enter as PRIOR examples (Segev, Harel, Mannor,
Crammer, El-Yaniv, "Learn on source, refine on target: a model transfer learning framework with random
forests", 2017).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from app.training.examples import POLE, TREE, UNKNOWN, UPRIGHT, Examples
from pipeline.classification.features import NAMES, RAYS
from pipeline.classification.forest import ALL_AROUND, CLASSES, FREE_END, ONE_WAY, ends_in_free_air
from pipeline.simulation.scenarios import SCHEME, WILD
from pipeline.types.records import Bool, Float, Float32, Int

PRIOR = 3.0  # weight of the previous class shares of a leaf, in objects
LEAST = 2.0  # least weight of a new leaf, in objects
DEEPER = 4  # largest number of additional splits on a path


@dataclass(frozen=True, slots=True)
class ForestSettings:
    """Settings of the forest for a kind of sensor.

    Attributes:
        method: "extra" splits at random thresholds, "best" at the best threshold of some features.
        trees, depth, least: Number of trees, their depth, and least examples of a leaf.
        leaves: Largest number of leaves of a tree, None for no limit.
        figures: Share of the features that is tried at each split.
        same, other, simulated: Weight of an example of a real scene of this kind of sensor, of a real scene
            of the other kind, and of a simulated scene.
        wild: Weight of an example of a stand of `sim:wild` that this kind of sensor sees.
        tree: Weight of trees, chosen so that the same share of votes separates trees best for both kinds of
            sensor.
        upright: Weight of poles and persons, which are few and difficult.
        rays: Whether the features of rays are used.
    """

    method: str
    trees: int
    depth: int
    least: int
    leaves: int | None
    figures: float
    same: float
    other: float
    simulated: float
    wild: float
    tree: float
    upright: float
    rays: bool


# A sensor that looks one way sees a trunk from one side and no higher than its field of view. Trained on
# simulated parks too, it finds fewer real trees, and four real parks are too few to learn from rays.
# The stands of `sim:wild` add stems in undergrowth, of which parks have none (see docs/trunks.md).
SETTINGS = {
    ALL_AROUND: ForestSettings(
        "best",
        40,
        18,
        6,
        150,
        0.3,
        same=5.0,
        other=1.0,
        simulated=1.0,
        wild=0.3,
        tree=0.67,
        upright=2.0,
        rays=True,
    ),
    ONE_WAY: ForestSettings(
        "extra",
        80,
        9,
        8,
        None,
        0.3,
        same=1.0,
        other=1.0,
        simulated=0.0,
        wild=0.05,
        tree=1.75,
        upright=1.0,
        rays=False,
    ),
}
# The forest that separates poles from trees that end in free air. It is trained on augmented scans only;
# there all poles together have `upright` times the weight of all trees (see `fit_free_end`).
FREE_END_SETTINGS = replace(
    SETTINGS[ONE_WAY], trees=60, depth=8, least=15,
    same=0.0, other=0.0, simulated=1.0, wild=0.0, tree=1.0, upright=1.5,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class FittedForest:
    """A forest of scikit-learn, and for each tree the class shares of its nodes, shape (nodes, classes)."""

    trees: Any
    share: list[Float]


def fit(examples: list[Examples], kind: str, seed: int = 0) -> FittedForest:
    """Fit a forest that separates trees from all else; its leaves hold the shares of all classes. Examples
    with the label UNKNOWN and scenes without weight for this kind of sensor are not used; at least one must
    remain, see `can_fit`.

    Args:
        examples: Examples of all training scenes.
        kind: Kind of the sensor, a key of SETTINGS.
        seed: Random seed.
    """
    settings = SETTINGS[kind]
    figures = np.concatenate([e.figures for e in examples])
    label = np.concatenate([e.label for e in examples])
    weight = np.concatenate([np.full(len(e.label), float(_weight(e, kind))) for e in examples])
    weight = _class_weight(weight, label, settings)
    used = (label != UNKNOWN) & (weight > 0.0)
    return _fitted(figures[used], label[used], weight[used], settings, seed)


def fit_free_end(augmented: list[Examples], seed: int = 0) -> FittedForest | None:
    """Fit a forest that separates trees from poles that end in free air; None unless there are examples of
    both.

    Args:
        augmented: Real scenes with inserted poles and trees, see `augmentation`.
        seed: Random seed.
    """
    figures = np.concatenate([np.zeros((0, len(NAMES))), *(e.figures for e in augmented)])
    label = np.concatenate([np.zeros(0, np.int64), *(e.label for e in augmented)])
    used = of_free_end(figures, label)
    figures, label = figures[used], label[used]
    tree = label == TREE
    if not tree.any() or tree.all():
        return None
    s = FREE_END_SETTINGS
    weight = np.where(tree, s.tree, s.upright * np.count_nonzero(tree) / np.count_nonzero(~tree))
    return _fitted(figures, label, weight, s, seed)


def _fitted(figures: Float, label: Int, weight: Float, settings: ForestSettings, seed: int) -> FittedForest:
    """Fit a forest of scikit-learn; features of rays are removed unless the settings use them.

    Args:
        figures: Features, shape (N, features).
        label: Index in CLASSES, shape (N,), none UNKNOWN.
        weight: Weight of each example, shape (N,).
        settings: Settings of the forest.
        seed: Random seed.
    """
    from sklearn.ensemble import ExtraTreesClassifier, RandomForestClassifier

    known = (figures if settings.rays else figures[:, :RAYS]).astype(np.float32)
    method = ExtraTreesClassifier if settings.method == "extra" else RandomForestClassifier
    trees = method(
        settings.trees,
        max_depth=settings.depth,
        min_samples_leaf=settings.least,
        max_leaf_nodes=settings.leaves,
        max_features=settings.figures,
        random_state=seed,
    ).fit(known, label == TREE, weight)
    return FittedForest(trees, [_shares(tree, known, label, weight) for tree in trees.estimators_])


def _class_weight(weight: Float, label: Int, settings: ForestSettings) -> Float:
    """Return weights multiplied by those of the classes, shape (N,).

    Args:
        weight: Weights, shape (N,).
        label: Index in CLASSES, shape (N,).
        settings: Settings with the factors `tree` of trees and `upright` of poles and persons; it is 1 for
            all others.
    """
    factor = np.where(label == TREE, settings.tree, 1.0)
    factor[np.isin(label, UPRIGHT)] = settings.upright
    return weight * factor


def of_free_end(figures: Float, label: Int) -> Bool:
    """Return which examples are poles or trees with a free upper end (`ends_in_free_air`), shape (N,), from
    their features and labels."""
    of: Bool = np.isin(label, (TREE, POLE)) & ends_in_free_air(figures)
    return of


def fit_all(
    examples: list[Examples], augmented: list[Examples], kinds: Iterable[str] = SETTINGS, seed: int = 0
) -> dict[str, FittedForest]:
    """Return the forests for some kinds of sensors, by their key in the JSON.

    A kind without sufficient examples is left out. With the kind ONE_WAY, the forest FREE_END is added, if
    the augmented examples are sufficient.

    Args:
        examples: Examples for the main forests.
        augmented: Examples of scans with inserted objects, for the forest FREE_END.
        kinds: Kinds of sensors.
        seed: Random seed.
    """
    fitted = {kind: fit(examples, kind, seed) for kind in kinds if can_fit(examples, kind)}
    free_end = fit_free_end(augmented, seed) if ONE_WAY in fitted else None
    return fitted if free_end is None else {**fitted, FREE_END: free_end}


def can_fit(examples: list[Examples], kind: str) -> bool:
    """Return whether any of the scenes has a weight for this kind of sensor; False without scenes."""
    return any(_weight(e, kind) > 0.0 for e in examples)


def _weight(examples: Examples, kind: str) -> float:
    """Return the weight of the examples of a scene for a kind of sensor, see `ForestSettings`."""
    settings = SETTINGS[kind]
    is_same = examples.all_around == (kind == ALL_AROUND)
    if examples.simulated:
        return settings.wild if is_same and f"{SCHEME}{WILD}" in examples.scene else settings.simulated
    return settings.same if is_same else settings.other


def _shares(tree: Any, figures: Float32, label: Int, weight: Float) -> Float:  # noqa: ANN401
    """Return the class shares of the nodes of a tree, shape (nodes, classes), rounded to 2 decimals; zeros
    for nodes that are no leaves.

    Args:
        tree: Tree of scikit-learn.
        figures: Features of the training examples, shape (N, features).
        label: Index in CLASSES, shape (N,).
        weight: Weight of each example, shape (N,).
    """
    share = np.zeros((tree.tree_.node_count, len(CLASSES)))
    np.add.at(share, (tree.apply(figures), label), weight)
    rounded: Float = np.round(share / np.maximum(share.sum(axis=1, keepdims=True), 1e-12), 2)
    return rounded


def as_json(fitted: dict[str, FittedForest], scenes: list[str]) -> dict[str, Any]:
    """Return the JSON that `pipeline.classification.forest.read_forest` reads.

    Args:
        fitted: Forests by their key in the JSON.
        scenes: Names of the training scenes, which are only written.
    """
    return {
        "about": "Votes on what a column is, made by `stemmap train`; see docs/trunks.md.",
        "scenes": scenes,
        "classes": [kind.label for kind in CLASSES],
        **{
            kind: [
                node_of(tree.tree_, share, 0)
                for tree, share in zip(f.trees.estimators_, f.share, strict=True)
            ]
            for kind, f in fitted.items()
        },
    }


def node_of(tree: Any, share: Float, row: int) -> dict[str, Any]:  # noqa: ANN401
    """Return the JSON of a node of a tree of scikit-learn, with all nodes below it. A split whose two leaves
    are equal becomes a leaf.

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
    """Return the extended trees for a kind of sensor, by their key in the JSON. For sensors that look one way
    these include the trees for columns with a free upper end, which would overrule the others.

    Args:
        base: JSON of the forest.
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
    """Return the extended trees of a forest; the given ones remain unchanged. Leaves that no example reaches,
    and all leaves without examples, stay as they are.

    Args:
        trees: Trees as in the JSON.
        settings: Settings with which they were trained.
        figures: Features, shape (N, features).
        label: Index in CLASSES, shape (N,).
        thing: Number of the object, shape (N,); each object has the same weight, for any number of examples.
        seed: Random seed.
    """
    _, of, number = np.unique(thing, return_inverse=True, return_counts=True)
    weight = _class_weight(1.0 / number[of], label, settings)
    draws = np.random.default_rng(seed).integers(0, 2**31, len(trees))
    return [
        _expanded_node(tree, figures, label, weight, settings, draw)
        for tree, draw in zip(trees, draws.tolist(), strict=True)
    ]


def _expanded_node(
    node: dict[str, Any], figures: Float, label: Int, weight: Float, settings: ForestSettings, draw: int
) -> dict[str, Any]:
    """Return a node with its leaves extended by the examples that reach it; the node itself without examples.

    Args:
        node: Node as in the JSON.
        figures, label: Features and classes of the examples that reach it, shapes (N, features) and (N,).
        weight: Their weights, shape (N,).
        settings: Settings of the forest.
        draw: Random seed of this tree.
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
    """Return a leaf, or the splits in its place, at most DEEPER levels. Each new leaf mixes the previous
    shares, with weight PRIOR, and those of its examples.

    Args:
        share: Previous class shares, shape (classes,).
        figures, label, weight: The examples, at least one, see `_expanded_node`.
        settings: Settings of the forest.
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
