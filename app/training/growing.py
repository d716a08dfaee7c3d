"""Growing: decision trees from examples, as JSON, and what they are worth on scenes they never saw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.gathering.features import NAMES
from pipeline.gathering.forest import CLASSES
from pipeline.records import Float, Int

TREES = 24
DEPTH = 9
LEAST_LEAF = 3  # examples
SIMULATED_WEIGHT = 0.3  # real scenes are what decides, and they are few
DOUBTFUL = -1


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


def grow(examples: list[Examples], seed: int = 0) -> Any:  # noqa: ANN401 - scikit-learn is untyped
    """Extremely randomised trees (Geurts 2006): with so few real scenes they agree better with new ones
    than the best tree of all."""
    from sklearn.ensemble import ExtraTreesClassifier

    figures = np.concatenate([e.figures for e in examples])
    label = np.concatenate([e.label for e in examples])
    weight = np.concatenate([np.full(len(e.label), SIMULATED_WEIGHT if e.simulated else 1.0) for e in examples])
    sure = label != DOUBTFUL
    trees = ExtraTreesClassifier(
        TREES, max_depth=DEPTH, min_samples_leaf=LEAST_LEAF, max_features=0.5, random_state=seed
    )
    return trees.fit(np.round(figures[sure], 4), label[sure], weight[sure])


def shares(trees: Any, figures: Float) -> Float:  # noqa: ANN401
    """Votes in the order of CLASSES, shape (N, classes)."""
    votes = np.zeros((len(figures), len(CLASSES)))
    votes[:, trees.classes_] = trees.predict_proba(figures)
    return votes


def as_json(trees: Any, scenes: list[str]) -> dict[str, Any]:  # noqa: ANN401
    """What `pipeline.gathering.forest.read_forest` reads."""
    return {
        "about": "Votes on what a column is; made by `stemmap train`. Each figure is described in docs/results.md.",
        "scenes": scenes,
        "classes": [kind.label for kind in CLASSES],
        "trees": [_node(tree.tree_, 0, trees.classes_) for tree in trees.estimators_],
    }


def _node(tree: Any, row: int, classes: Int) -> dict[str, Any]:  # noqa: ANN401
    if tree.children_left[row] < 0:
        share = np.zeros(len(CLASSES))
        share[classes] = tree.value[row, 0] / tree.value[row, 0].sum()
        return {"share": [round(float(v), 3) for v in share]}
    return {
        "figure": NAMES[tree.feature[row]],
        "at_most": round(float(tree.threshold[row]), 4),
        "yes": _node(tree, tree.children_left[row], classes),
        "no": _node(tree, tree.children_right[row], classes),
    }
