"""What the map is scored against: what the source knows to stand there, what people annotated, or both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app.store.records import Annotation, Content
from pipeline.types.records import TruthTrees

Against = Literal["both", "own", "annotations"]
Counted = Literal["none", "source", "annotations", "both"]

# So near to an annotation, what the source says to stand there is the same thing [m].
SAME_THING = 0.5
# So many things of the source are looked at for an annotation: no more stems stand within SAME_THING.
_MOST_NEAR = 8


def truth_of(own: TruthTrees | None, rows: Sequence[Annotation], against: Against) -> TruthTrees | None:
    """The truth that counts.

    Args:
        own: What the source knows, if anything. It is never changed.
        rows: The annotations.
        against: "own" leaves annotations aside, "annotations" the source's truth, "both" neither.

    Returns:
        None where nothing counts.
    """
    used = counted(own, rows, against)
    if used == "both":
        return laid_over(own, rows)
    if used == "annotations":
        return _as_truth([row.content for row in rows])
    return own if used == "source" else None


def counted(own: TruthTrees | None, rows: Sequence[Annotation], against: Against) -> Counted:
    """What counts, where one of the two may not be there."""
    if own is None:
        return "annotations" if rows and against != "own" else "none"
    # Who asked for what people say is not told what the source knows.
    if not rows and against == "annotations":
        return "none"
    if not rows or against == "own":
        return "source"
    return against


def laid_over(own: TruthTrees | None, rows: Sequence[Annotation]) -> TruthTrees | None:
    """What the source knows, and over it what was annotated within SAME_THING: what says otherwise takes its
    place; what agrees leaves the source's place and diameter (unless one was typed), for who confirms a tree
    that was found did not measure where it stands.
    """
    if not rows:
        return own
    if own is None or not len(own.x):
        return _as_truth([row.content for row in rows])
    nearest = _nearest(own, rows)
    contents = [_agreed(own, k, row.content) for k, row in zip(nearest.tolist(), rows, strict=True)]
    said = _as_truth(contents)
    # Only what an annotation is of: who confirms one stem says nothing of another that stands beside it.
    keep = np.setdiff1d(np.arange(len(own.x)), nearest)
    return TruthTrees(
        np.concatenate([own.x[keep], said.x]),
        np.concatenate([own.y[keep], said.y]),
        np.concatenate([own.dbh[keep], said.dbh]),
        (*(own.kind[k] for k in keep), *said.kind),
    )


def contradicting(own: TruthTrees | None, rows: Sequence[Annotation]) -> int:
    """How many annotations say of a thing that the source knows that it is something else."""
    if own is None or not rows or not len(own.x):
        return 0
    near = zip(_nearest(own, rows).tolist(), rows, strict=True)
    return sum(k >= 0 and own.kind[k] != row.content.kind for k, row in near)


def contents_of(truth: TruthTrees) -> list[Content]:
    """The rows of a table of trees."""
    columns = zip(truth.x.tolist(), truth.y.tolist(), truth.kind, truth.dbh.tolist(), strict=True)
    return [Content(x, y, kind, dbh if dbh == dbh else None) for x, y, kind, dbh in columns]


def _as_truth(contents: Sequence[Content]) -> TruthTrees:
    return TruthTrees(
        np.array([c.x for c in contents]),
        np.array([c.y for c in contents]),
        np.array([np.nan if c.dbh is None else c.dbh for c in contents]),
        tuple(c.kind for c in contents),
    )


def _agreed(own: TruthTrees, k: int, content: Content) -> Content:
    """An annotation, at the place of what the source knows (row k, -1: nothing is near) if both agree."""
    if k < 0 or own.kind[k] != content.kind:
        return content
    known = float(own.dbh[k])
    dbh = content.dbh if content.dbh is not None or np.isnan(known) else known
    return Content(float(own.x[k]), float(own.y[k]), content.kind, dbh)


def _nearest(own: TruthTrees, rows: Sequence[Annotation]) -> NDArray[np.int64]:
    """Which row of what the source knows each annotation is of, each of at most one, the nearest pairs first;
    -1 where nothing that is left stands within SAME_THING: (A,)."""
    from scipy.spatial import cKDTree

    places = np.array([(row.content.x, row.content.y) for row in rows])
    ranks = np.arange(1, min(_MOST_NEAR, len(own.x)) + 1)
    gaps, near = cKDTree(np.column_stack([own.x, own.y])).query(places, ranks)
    found = np.full(len(rows), -1, dtype=np.int64)
    taken: set[int] = set()
    for flat in np.argsort(gaps, axis=None, kind="stable").tolist():
        a, rank = divmod(flat, len(ranks))
        if gaps[a, rank] > SAME_THING:
            break
        k = int(near[a, rank])
        if found[a] < 0 and k not in taken:
            taken.add(k)
            found[a] = k
    return found
