"""Fitting of random forests to examples, as JSON."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from app.extensions.learning.examples import TREE, UNKNOWN, Examples
from app.extensions.learning.fit_forest import (
    FREE_END_SETTINGS,
    SETTINGS,
    ForestSettings,
    class_weight,
    node_of,
    of_free_end,
)
from pipeline.classification.features import NAMES, RAYS
from pipeline.classification.forest import ALL_AROUND, CLASSES, FREE_END, ONE_WAY
from pipeline.simulation.scenarios import SCHEME, WILD
from pipeline.types.records import Float, Float32, Int


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Settings of the fit for a kind of sensor, besides `ForestSettings`.

    Attributes:
        method: "extra" splits at random thresholds, "best" at the best threshold of some features.
        trees, depth, least: Number of trees, their depth, and least examples of a leaf.
        leaves: Largest number of leaves of a tree, None for no limit.
        same, other, simulated: Weight of an example of a real scene of this kind of sensor, of a real scene
            of the other kind, and of a simulated scene.
        wild: Weight of an example of a stand of `sim:wild` that this kind of sensor sees.
    """

    method: str
    trees: int
    depth: int
    least: int
    leaves: int | None
    same: float
    other: float
    simulated: float
    wild: float


# Trained on simulated parks too, a sensor that looks one way finds fewer real trees. The stands of `sim:wild`
# add stems in undergrowth, of which parks have none (see docs/trunks.md).
FITS = {
    ALL_AROUND: FitSettings("best", 40, 18, 6, 150, same=5.0, other=1.0, simulated=1.0, wild=0.3),
    ONE_WAY: FitSettings("extra", 80, 9, 8, None, same=1.0, other=1.0, simulated=0.0, wild=0.05),
}
# The forest of free ends is trained on augmented scans only; there all poles together have `upright` times
# the weight of all trees (see `fit_free_end`).
FREE_END_FIT = replace(FITS[ONE_WAY], trees=60, depth=8, least=15)


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
    weight = class_weight(weight, label, settings)
    used = (label != UNKNOWN) & (weight > 0.0)
    return _fitted(figures[used], label[used], weight[used], FITS[kind], settings, seed)


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
    return _fitted(figures, label, weight, FREE_END_FIT, s, seed)


def _fitted(
    figures: Float, label: Int, weight: Float, fit: FitSettings, settings: ForestSettings, seed: int
) -> FittedForest:
    """Fit a forest of scikit-learn; features of rays are removed unless the settings use them.

    Args:
        figures: Features, shape (N, features).
        label: Index in CLASSES, shape (N,), none UNKNOWN.
        weight: Weight of each example, shape (N,).
        fit, settings: Settings of the forest.
        seed: Random seed.
    """
    from sklearn.ensemble import ExtraTreesClassifier, RandomForestClassifier

    known = (figures if settings.rays else figures[:, :RAYS]).astype(np.float32)
    method = ExtraTreesClassifier if fit.method == "extra" else RandomForestClassifier
    trees = method(
        fit.trees,
        max_depth=fit.depth,
        min_samples_leaf=fit.least,
        max_leaf_nodes=fit.leaves,
        max_features=settings.figures,
        random_state=seed,
    ).fit(known, label == TREE, weight)
    return FittedForest(trees, [_shares(tree, known, label, weight) for tree in trees.estimators_])


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
    """Return the weight of the examples of a scene for a kind of sensor, see `FitSettings`."""
    settings = FITS[kind]
    is_same = examples.all_around == (kind == ALL_AROUND)
    if examples.simulated:
        return settings.wild if is_same and f"{SCHEME}{WILD}" in examples.scene else settings.simulated
    return settings.same if is_same else settings.other


def _shares(tree: Any, figures: Float32, label: Int, weight: Float) -> Float:
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
        "about": "Votes on what a column is, made by tests.benchmarks.package_forest; see docs/trunks.md.",
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
