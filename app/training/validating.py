"""Validating: what decision trees that learn from annotations are worth on things that they never saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.training.annotated import things_of
from app.training.expanding import all_expanded
from app.training.fit_forest import TREE, Examples
from pipeline.classification.decision_rule import too_few
from pipeline.classification.forest import Forest, forest_of, vote
from pipeline.evaluation import Rate
from pipeline.types.records import Bool, Float, Int

FOLDS = 5
LEAST_RUNS = 3  # from which on whole runs are left out
SAME_PLACE = 1.0  # m; things nearer to one another are never in two folds, whatever their runs


@dataclass(frozen=True, slots=True)
class Rates:
    """TA and FR of the trees, TR and FA of all else, by the last that was known of each thing."""

    TA: Rate
    TR: Rate
    FA: Rate
    FR: Rate

    @classmethod
    def of(cls, accepted: Bool, tree: Bool) -> Rates:
        """From what was taken for a tree, and what is one, shape (N,) each."""
        trees, others = int(tree.sum()), int((~tree).sum())
        ta, fa = int((accepted & tree).sum()), int((accepted & ~tree).sum())
        return cls(Rate(ta, trees), Rate(others - fa, others), Rate(fa, others), Rate(trees - ta, trees))


@dataclass(frozen=True, slots=True)
class Validated:
    """Old and new decision trees on the same things, the new ones grown each time without those they judge.

    Attributes:
        by: "run" or "place": what was left out as a whole; folds: how many parts there were.
    """

    by: str
    folds: int
    old: Rates
    new: Rates


def validate(
    examples: Sequence[Examples], base: dict[str, Any], kind: str, old: Forest, share: float, seed: int
) -> Validated:
    """Cross-validate what is learned from examples.

    Args:
        examples: Of runs seen by one kind of sensor; at least two places.
        base: JSON of the forest that learns; kind: of the sensor.
        old: The forest that is in force.
        share: Of the votes for a tree from which on something is one.
        seed: Of the folds and of what is grown.
    """
    figures = np.concatenate([e.figures for e in examples])
    label = np.concatenate([e.label for e in examples])
    thing = things_of(examples)
    last = np.flatnonzero(np.append(thing[1:] != thing[:-1], True))
    by, group = groups_of(examples)
    accepted_old = _accepted(figures, old, share)
    accepted_new = np.zeros(len(label), np.bool_)
    folds = fold_of(group, label == TREE, thing, seed)
    for fold in np.unique(folds):
        rest, judged = folds != fold, folds == fold
        grown = all_expanded(base, kind, figures[rest], label[rest], thing[rest], seed)
        forest = forest_of({**base, **grown}, kind)
        accepted_new[judged] = _accepted(figures[judged], forest, share)
    tree = label[last] == TREE
    return Validated(
        by,
        len(np.unique(folds)),
        Rates.of(accepted_old[last], tree),
        Rates.of(accepted_new[last], tree),
    )


def groups_of(examples: Sequence[Examples]) -> tuple[str, Int]:
    """What is left out as a whole, "run" or "place", and the number of that of each example.

    Runs that share a place are one, and so are places in one run and in another that have the same
    coordinates: two drives that began at the same spot saw the same stems.
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
    """The fold of each example: no group is in two, and each has about its part of the trees."""
    from sklearn.model_selection import StratifiedGroupKFold

    _, first = np.unique(thing, return_index=True)  # a thing counts once
    number = min(FOLDS, len(np.unique(group)))
    split = StratifiedGroupKFold(number, shuffle=True, random_state=seed)
    of_group: dict[int, int] = {}
    for fold, (_, judged) in enumerate(split.split(np.zeros((len(first), 1)), tree[first], group[first])):
        of_group.update(dict.fromkeys(group[first][judged].tolist(), fold))
    return np.array([of_group[g] for g in group.tolist()], np.int64)


def _accepted(figures: Float, forest: Forest, share: float) -> Bool:
    accepted: Bool = (vote(figures, forest)[:, 0] >= share) & ~too_few(figures)
    return accepted
