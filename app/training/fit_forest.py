"""Growing: decision trees from examples, as JSON, and what they are worth on scenes they never saw."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.classification.features import NAMES, RAYS
from pipeline.classification.forest import ALL_AROUND, CLASSES, FREE_END, ONE_WAY, ends_in_free_air
from pipeline.types.records import Bool, Float, Int, Verdict

DOUBTFUL = -1
TREE = CLASSES.index(Verdict.TREE)
POLE = CLASSES.index(Verdict.POLE)
UPRIGHT = (POLE, CLASSES.index(Verdict.PERSON))


@dataclass(frozen=True, slots=True)
class Plan:
    """How trees are grown for a kind of sensor.

    Attributes:
        method: "extra" cuts at random places, "best" at the best one of a random choice of figures.
        trees, depth, least: Their number, their depth, and the least examples in a leaf.
        leaves: Most leaves of a tree; cuts that tell most come first. None: as many as there are.
        figures: Part of the figures that is tried at each cut.
        same, other, simulated: What an example counts from a real scene of this kind of sensor, of the
            other kind, and from a simulated scene.
        tree: What a tree counts: by it the share of votes that parts trees from all else best is the
            same for both kinds of sensor.
        upright: How many times more poles and persons count: they are few and hard to tell.
        rays: Whether figures that rays tell are asked for.
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
    tree: float
    upright: float
    rays: bool


# A sensor that looks one way sees a trunk from one side and no higher than its field of view: trained on
# simulated parks too, it finds fewer real ones, and four real parks are too few to learn from what rays
# tell (docs/trunks.md has the figures).
PLANS = {
    ALL_AROUND: Plan(
        "best", 40, 18, 6, 150, 0.3, same=5.0, other=1.0, simulated=1.0, tree=0.67, upright=2.0, rays=True
    ),
    ONE_WAY: Plan(
        "extra", 80, 9, 8, None, 0.3, same=1.0, other=1.0, simulated=0.0, tree=1.75, upright=1.0, rays=False
    ),
}
# What tells a pole that ends in free air from a tree that does. It learns from copies alone; in them all
# poles together count so many times as much as all trees (see `grow_free_end`).
FREE_END_PLAN = Plan(
    "extra", 60, 8, 15, None, 0.3, same=0.0, other=0.0, simulated=1.0, tree=1.0, upright=1.5, rays=False
)


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """Columns of one scene with what they really are.

    Attributes:
        scene: Its name; a scene is either trained on or judged, never both.
        simulated: Whether it is no real one; all_around: whether its sensor sees all around.
        axis: shape (N, 5), see `find_columns`.
        figures: shape (N, figures).
        label: int64, place in CLASSES, DOUBTFUL where nobody can tell.
    """

    scene: str
    simulated: bool
    all_around: bool
    axis: Float
    figures: Float
    label: Int


@dataclass(frozen=True, slots=True, eq=False)
class Grown:
    """Trees of scikit-learn, and for each the shares of the kinds in its nodes, shape (nodes, classes)."""

    trees: Any
    share: list[Float]


def grow(examples: list[Examples], kind: str, seed: int = 0) -> Grown:
    """Many small trees agree better with new scenes than one does (Breiman 2001, Geurts 2006). They are
    cut to tell trees from all else; the leaves then say what else.

    Args:
        examples: Of all scenes to learn from.
        kind: Of the sensor, a key of PLANS.
        seed: Of the choices made at random.
    """
    from sklearn.ensemble import ExtraTreesClassifier, RandomForestClassifier

    plan = PLANS[kind]
    figures = np.concatenate([e.figures for e in examples]).astype(np.float32)
    label = np.concatenate([e.label for e in examples])
    weight = np.concatenate([np.full(len(e.label), float(_weight(e, kind, plan))) for e in examples])
    weight[label == TREE] *= plan.tree
    weight[np.isin(label, UPRIGHT)] *= plan.upright
    used = (label != DOUBTFUL) & (weight > 0.0)
    figures, label, weight = figures[used], label[used], weight[used]
    if not plan.rays:
        figures = figures[:, :RAYS]
    method = ExtraTreesClassifier if plan.method == "extra" else RandomForestClassifier
    trees = method(
        plan.trees,
        max_depth=plan.depth,
        min_samples_leaf=plan.least,
        max_leaf_nodes=plan.leaves,
        max_features=plan.figures,
        random_state=seed,
    ).fit(figures, label == TREE, weight)
    return Grown(trees, [_shares(tree, figures, label, weight) for tree in trees.estimators_])


def grow_free_end(pasted: list[Examples], seed: int = 0) -> Grown | None:
    """Trees and poles that end in free air, told from one another; None where there are not both.

    Args:
        pasted: Real scenes with poles and trees pasted into them, see `pasting`.
        seed: Of the choices made at random.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    figures = np.concatenate([np.zeros((0, len(NAMES))), *(e.figures for e in pasted)])
    label = np.concatenate([np.zeros(0, np.int64), *(e.label for e in pasted)])
    used = of_free_end(figures, label)
    figures, label = figures[used, :RAYS].astype(np.float32), label[used]
    tree = label == TREE
    if not tree.any() or tree.all():
        return None
    plan = FREE_END_PLAN
    weight = np.where(tree, plan.tree, plan.upright * np.count_nonzero(tree) / np.count_nonzero(~tree))
    trees = ExtraTreesClassifier(
        plan.trees,
        max_depth=plan.depth,
        min_samples_leaf=plan.least,
        max_features=plan.figures,
        random_state=seed,
    ).fit(figures, tree, weight)
    return Grown(trees, [_shares(each, figures, label, weight) for each in trees.estimators_])


def of_free_end(figures: Float, label: Int) -> Bool:
    """Which examples tell a pole that ends in free air from a tree that does, shape (N,)."""
    of: Bool = np.isin(label, (TREE, POLE)) & ends_in_free_air(figures)
    return of


def grow_all(
    examples: list[Examples], pasted: list[Examples], kinds: Iterable[str] = PLANS, seed: int = 0
) -> dict[str, Grown]:
    """All that can be grown for these kinds of sensors, by the key under which the JSON holds it."""
    grown = {kind: grow(examples, kind, seed) for kind in kinds if can_grow(examples, kind)}
    free_end = grow_free_end(pasted, seed) if ONE_WAY in grown else None
    return grown if free_end is None else {**grown, FREE_END: free_end}


def can_grow(examples: list[Examples], kind: str) -> bool:
    """Whether any of the scenes counts for this kind of sensor."""
    return any(_weight(e, kind, PLANS[kind]) > 0.0 for e in examples)


def _weight(examples: Examples, kind: str, plan: Plan) -> float:
    if examples.simulated:
        return plan.simulated
    return plan.same if examples.all_around == (kind == ALL_AROUND) else plan.other


def _shares(tree: Any, figures: Float, label: Int, weight: Float) -> Float:  # noqa: ANN401
    share = np.zeros((tree.tree_.node_count, len(CLASSES)))
    np.add.at(share, (tree.apply(figures), label), weight)
    rounded: Float = np.round(share / np.maximum(share.sum(axis=1, keepdims=True), 1e-12), 2)
    return rounded


def shares(grown: Grown, figures: Float) -> Float:
    """Votes in the order of CLASSES, shape (N, classes)."""
    leaf = grown.trees.apply(figures[:, : grown.trees.n_features_in_].astype(np.float32))
    votes: Float = np.mean([share[leaf[:, k]] for k, share in enumerate(grown.share)], axis=0)
    return votes


def as_json(grown: dict[str, Grown], scenes: list[str]) -> dict[str, Any]:
    """What `pipeline.classification.forest.read_forest` reads."""
    return {
        "about": "Votes on what a column is, made by `stemmap train`; see docs/trunks.md.",
        "scenes": scenes,
        "classes": [kind.label for kind in CLASSES],
        **{
            kind: [
                node_of(tree.tree_, share, 0)
                for tree, share in zip(g.trees.estimators_, g.share, strict=True)
            ]
            for kind, g in grown.items()
        },
    }


def node_of(tree: Any, share: Float, row: int) -> dict[str, Any]:  # noqa: ANN401
    """The JSON of a node of a tree of scikit-learn; `share`: of the kinds in each node, (nodes, classes)."""
    if tree.children_left[row] < 0:
        return {"share": [int(v) if v in (0.0, 1.0) else v for v in share[row].tolist()]}
    yes = node_of(tree, share, tree.children_left[row])
    no = node_of(tree, share, tree.children_right[row])
    if "share" in yes and yes == no:
        return yes
    threshold = round(float(tree.threshold[row]), 4)
    return {"figure": NAMES[tree.feature[row]], "at_most": threshold, "yes": yes, "no": no}
