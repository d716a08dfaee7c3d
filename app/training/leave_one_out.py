"""Judging what was grown: each real scene by trees that never saw it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from app.training.augmentation import is_of
from app.training.fit_forest import DOUBTFUL, TREE, Examples, as_json, can_grow, grow_all
from pipeline.classification.forest import ALL_AROUND, ONE_WAY, forest_of, vote
from pipeline.evaluation.matching import match
from pipeline.types.records import Float

APART = 0.5  # m


def leave_one_out(examples: list[Examples], pasted: list[Examples], share: float) -> Iterator[str]:
    """A line for each real scene: trees found, of how many, and false ones, by trees grown from all others.

    The last set of a scene is judged: all its scans together. `pasted`: copies of scenes with things
    pasted in; those of the scene that is judged are left out with it.
    """
    for scene in dict.fromkeys(e.scene for e in examples if not e.simulated):
        others = [e for e in examples if e.scene != scene]
        last = [e for e in examples if e.scene == scene][-1]
        kind = ALL_AROUND if last.all_around else ONE_WAY
        if can_grow(others, kind):
            grown = grow_all(others, [e for e in pasted if not is_of(e.scene, scene)], (kind,))
            votes = vote(last.figures, forest_of(as_json(grown, []), kind))
            hit, of, false = count(last, votes[:, TREE], share)
            yield f"left out {scene}: {hit} of {of} trees, {false} false"


def count(scene: Examples, votes: Float, share: float) -> tuple[int, int, int]:
    """Trees found, trees there, and false ones; what nobody can tell counts as neither."""
    rows = [int(k) for k in np.argsort(-votes, kind="stable") if votes[k] >= share]
    place = scene.axis[:, :2]
    kept: list[int] = []
    for k in rows:
        if all(np.hypot(*(place[k] - place[j])) > APART for j in kept):
            kept.append(k)
    truth = place[_one_each(place, scene.label == TREE)]
    truth_of = match(place[kept], truth, APART)
    false = sum(truth_of[n] < 0 and scene.label[k] != DOUBTFUL for n, k in enumerate(kept))
    return int(np.count_nonzero(truth_of >= 0)), len(truth), int(false)


def _one_each(place: Float, tree: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> list[int]:
    """One column of each tree: several may stand within it."""
    kept: list[int] = []
    for k in np.flatnonzero(tree).tolist():
        if all(np.hypot(*(place[k] - place[j])) > APART for j in kept):
            kept.append(k)
    return kept
