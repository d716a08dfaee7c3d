"""Growing: decision trees from examples, as JSON, and what they are worth on scenes they never saw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.gathering.features import NAMES
from pipeline.gathering.forest import ALL_AROUND, CLASSES, ONE_WAY
from pipeline.records import Float, Int, Verdict

DOUBTFUL = -1


@dataclass(frozen=True, slots=True)
class Plan:
    """How trees are grown for a kind of sensor: their number, depth, the least examples in a leaf, and
    what a column of a simulated scene counts beside one of a real scene, of which there are few."""

    trees: int
    depth: int
    least: int
    simulated: float


# A sensor that looks one way sees a trunk from one side and no higher than its field of view; examples
# that were driven around teach it to expect more (docs/results.md has both figures).
PLANS = {ALL_AROUND: Plan(20, 10, 8, 0.1), ONE_WAY: Plan(40, 9, 3, 0.0)}


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """Columns of one scene with what they really are.

    Attributes:
        scene: Its name; a scene is either trained on or judged, never both.
        simulated: Whether it is no real one.
        axis: shape (N, 5), see `find_columns`.
        figures: shape (N, figures).
        label: int64, place in CLASSES, DOUBTFUL where nobody can tell.
    """

    scene: str
    simulated: bool
    axis: Float
    figures: Float
    label: Int


@dataclass(frozen=True, slots=True, eq=False)
class Grown:
    """Trees of scikit-learn, and for each the shares of the kinds in its nodes, shape (nodes, classes)."""

    trees: Any
    share: list[Float]


def grow(examples: list[Examples], plan: Plan, seed: int = 0) -> Grown:
    """Extremely randomised trees (Geurts 2006): with so few real scenes they agree better with new ones
    than one tree does. They are split to tell trees from all else; the leaves then say what else."""
    from sklearn.ensemble import ExtraTreesClassifier

    used = [e for e in examples if plan.simulated > 0.0 or not e.simulated]
    figures = np.concatenate([e.figures for e in used]).astype(np.float32)
    label = np.concatenate([e.label for e in used])
    weight = np.concatenate([np.full(len(e.label), plan.simulated if e.simulated else 1.0) for e in used])
    sure = label != DOUBTFUL
    figures, label, weight = figures[sure], label[sure], weight[sure]
    trees = ExtraTreesClassifier(
        plan.trees, max_depth=plan.depth, min_samples_leaf=plan.least, max_features=0.5, random_state=seed
    ).fit(figures, label == CLASSES.index(Verdict.TREE), weight)
    return Grown(trees, [_shares(tree, figures, label, weight) for tree in trees.estimators_])


def _shares(tree: Any, figures: Float, label: Int, weight: Float) -> Float:  # noqa: ANN401
    share = np.zeros((tree.tree_.node_count, len(CLASSES)))
    np.add.at(share, (tree.apply(figures), label), weight)
    rounded: Float = np.round(share / np.maximum(share.sum(axis=1, keepdims=True), 1e-12), 2)
    return rounded


def shares(grown: Grown, figures: Float) -> Float:
    """Votes in the order of CLASSES, shape (N, classes)."""
    leaf = grown.trees.apply(figures.astype(np.float32))
    votes: Float = np.mean([share[leaf[:, k]] for k, share in enumerate(grown.share)], axis=0)
    return votes


def as_json(grown: dict[str, Grown], scenes: list[str]) -> dict[str, Any]:
    """What `pipeline.gathering.forest.read_forest` reads."""
    return {
        "about": "Votes on what a column is, made by `stemmap train`; see docs/results.md.",
        "scenes": scenes,
        "classes": [kind.label for kind in CLASSES],
        **{
            kind: [_node(tree.tree_, share, 0) for tree, share in zip(g.trees.estimators_, g.share, strict=True)]
            for kind, g in grown.items()
        },
    }


def _node(tree: Any, share: Float, row: int) -> dict[str, Any]:  # noqa: ANN401
    if tree.children_left[row] < 0:
        return {"share": share[row].tolist()}
    yes = _node(tree, share, tree.children_left[row])
    no = _node(tree, share, tree.children_right[row])
    if "share" in yes and yes == no:
        return yes
    threshold = round(float(tree.threshold[row]), 4)
    return {"figure": NAMES[tree.feature[row]], "at_most": threshold, "yes": yes, "no": no}
