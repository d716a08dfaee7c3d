"""Cross-validation of forests that are trained with annotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.training.examples import TREE, Examples, object_numbers
from app.training.fit_forest import all_expanded
from pipeline.classification.column_classifier import too_few
from pipeline.classification.forest import Forest, forest_of, vote
from pipeline.evaluation import Rate
from pipeline.types.records import Bool, Float, Int

FOLDS = 5
LEAST_RUNS = 3  # with so many runs, whole runs are left out
SAME_PLACE = 1.0  # m; objects within this distance are always in the same fold, also of different runs


@dataclass(frozen=True, slots=True)
class Rates:
    """TA and FR of trees, TR and FA of other objects, by the last example of each object."""

    TA: Rate
    TR: Rate
    FA: Rate
    FR: Rate

    @classmethod
    def of(cls, accepted: Bool, tree: Bool) -> Rates:
        """Return the rates of accepted objects and true trees, shape (N,) each."""
        trees, others = int(tree.sum()), int((~tree).sum())
        ta, fa = int((accepted & tree).sum()), int((accepted & ~tree).sum())
        return cls(Rate(ta, trees), Rate(others - fa, others), Rate(fa, others), Rate(trees - ta, trees))


@dataclass(frozen=True, slots=True)
class Validation:
    """Scores of the present and the new forest on the same objects. The new forest of each fold is trained
    without its objects.

    Attributes:
        by: "run" or "place": the groups that are left out as a whole.
        folds: Number of folds.
    """

    by: str
    folds: int
    old: Rates
    new: Rates


def validate(
    examples: Sequence[Examples], base: dict[str, Any], kind: str, old: Forest, share: float, seed: int
) -> Validation:
    """Cross-validate the training. The new forest decides on each object in the fold that left it out; only
    the last example of each object counts.

    Args:
        examples: Examples of one kind of sensor, from at least two places.
        base: JSON of the forest that is extended.
        kind: Kind of the sensor.
        old: The present forest.
        share: Share of votes that makes a tree.
        seed: Random seed of the folds and the training.
    """
    figures = np.concatenate([e.figures for e in examples])
    label = np.concatenate([e.label for e in examples])
    thing = object_numbers(examples)
    last = np.flatnonzero(np.append(thing[1:] != thing[:-1], True))
    by, group = groups_of(examples)
    accepted_old = _accepted(figures, old, share)
    accepted_new = np.zeros(len(label), np.bool_)
    folds = fold_of(group, label == TREE, thing, seed)
    for fold in np.unique(folds):
        rest, left_out = folds != fold, folds == fold
        grown = all_expanded(base, kind, figures[rest], label[rest], thing[rest], seed)
        forest = forest_of({**base, **grown}, kind)
        accepted_new[left_out] = _accepted(figures[left_out], forest, share)
    tree = label[last] == TREE
    return Validation(
        by,
        len(np.unique(folds)),
        Rates.of(accepted_old[last], tree),
        Rates.of(accepted_new[last], tree),
    )


def groups_of(examples: Sequence[Examples]) -> tuple[str, Int]:
    """Return the kind of group that is left out, "run" or "place", and the group number of each example,
    shape (N,). Runs are left out if there are at least LEAST_RUNS groups of them, otherwise places.

    Runs that share a place form one group, and so do places with the same coordinates in two runs, because
    drives that begin at the same point see the same stems.

    Args:
        examples: Examples of each run; together at least one.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from sklearn.cluster import DBSCAN

    axis = np.concatenate([e.axis for e in examples])[:, :2]
    run = np.concatenate([np.full(len(e.label), k) for k, e in enumerate(examples)])
    place: Int = DBSCAN(eps=SAME_PLACE, min_samples=1).fit(axis).labels_.astype(np.int64)
    n = len(examples)
    shared = coo_array((np.ones(len(run)), (run, n + place)), shape=(n + place.max() + 1,) * 2)
    together = connected_components(shared, directed=False)[1][run]
    if len(np.unique(together)) >= LEAST_RUNS:
        return "run", together.astype(np.int64)
    return "place", place


def fold_of(group: Int, tree: Bool, thing: Int, seed: int) -> Int:
    """Return the fold of each example, int64, shape (N,). A group is in one fold, and the folds have similar
    shares of trees. There are FOLDS folds, or as many as there are groups if these are fewer.

    Args:
        group: Number of the group of each example, shape (N,); at least two groups.
        tree: Whether it is of a tree, shape (N,).
        thing: Number of its object, shape (N,); an object counts once, however many examples it has.
        seed: Random seed.
    """
    from sklearn.model_selection import StratifiedGroupKFold

    _, first = np.unique(thing, return_index=True)  # an object counts once
    number = min(FOLDS, len(np.unique(group)))
    split = StratifiedGroupKFold(number, shuffle=True, random_state=seed)
    of_group: dict[int, int] = {}
    for fold, (_, left_out) in enumerate(split.split(np.zeros((len(first), 1)), tree[first], group[first])):
        of_group.update(dict.fromkeys(group[first][left_out].tolist(), fold))
    return np.array([of_group[g] for g in group.tolist()], np.int64)


def _accepted(figures: Float, forest: Forest, share: float) -> Bool:
    """Return which examples are accepted as trees, shape (N,): their share of votes suffices and they have
    enough observations.

    Args:
        figures: Features, shape (N, features).
        forest: The forest.
        share: Share of votes that makes a tree.
    """
    accepted: Bool = (vote(figures, forest)[:, 0] >= share) & ~too_few(figures)
    return accepted
