"""Training of a random forest with annotations, and its comparison with the forest in force by cross-
validation.

The page trains in a process of its own, `python -m app.extensions.learning.learning`. It receives a
`LearningRequest` and sends `{"progress": text}` messages, then `{"learned": ...}` or `{"error": text}`.
Recordings are read there and not in the server.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from app.batch.summary import rate_text
from app.common.child_process import ParentConnection, run_child
from app.common.text import count, version
from app.extensions.learning import LEAST_OTHERS, LEAST_TREES
from app.extensions.learning.examples import (
    TREE,
    AnnotatedRun,
    Examples,
    Progress,
    annotated_run,
    examples_of,
    object_numbers,
)
from app.extensions.learning.fit_forest import all_expanded
from app.store.forests import Forests
from app.store.records import moment
from app.store.store import AnnotatedSource
from pipeline.classification.column_classifier import too_few as too_few_voxels
from pipeline.classification.forest import (
    ALL_AROUND,
    CLASSES,
    FILE,
    ONE_WAY,
    PACKAGE,
    Forest,
    forest_of,
    read_forests,
    vote,
)
from pipeline.config.stages import Classification
from pipeline.errors import SourceError, StemmapError
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
        """Return the rates of N objects.

        Args:
            accepted: Whether an object is accepted as a tree, shape (N,).
            tree: Whether it is a tree, shape (N,).
        """
        trees, others = int(tree.sum()), int((~tree).sum())
        ta, fa = int((accepted & tree).sum()), int((accepted & ~tree).sum())
        return cls(Rate(ta, trees), Rate(others - fa, others), Rate(fa, others), Rate(trees - ta, trees))


@dataclass(frozen=True, slots=True)
class Validation:
    """Scores of the present and the new random forest on the same objects. The new random forest of each fold
    is trained without the objects of the fold.

    Attributes:
        by: Groups that are left out as a whole: "run" or "place", see `groups_of`.
        folds: Number of folds.
    """

    by: str
    folds: int
    old: Rates
    new: Rates


def validate(
    examples: Sequence[Examples], base: dict[str, Any], kind: str, old: Forest, share: float, seed: int
) -> Validation:
    """Cross-validate the training. The new random forest decides on each object in the fold that left it out;
    only the last example of each object counts.

    Args:
        examples: Examples of one kind of sensor, from at least two groups of `groups_of`; those of an object
            follow one another, the newest last.
        base: JSON of the random forest that is extended.
        kind: Kind of the sensor, ALL_AROUND or ONE_WAY.
        old: The present random forest.
        share: Minimum share of votes for a tree.
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
    """Return the kind of the groups, "run" or "place", and the group number of each of N examples, int64,
    shape (N,); the numbers need not be consecutive.

    A place is a cluster of objects, of any run, each within SAME_PLACE of another one in x, y. A group of the
    kind "run" has all runs that share places. If there are fewer than LEAST_RUNS of these groups, each place
    is a group instead.

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
        tree: Whether each example is of a tree, shape (N,).
        thing: Number of the object of each example, shape (N,); an object counts once for any number of
            examples.
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
    """Return which examples are accepted as trees, shape (N,): their share of votes is at least `share`, and
    they do not have too few voxels.

    Args:
        figures: Features, shape (N, features).
        forest: The forest.
        share: Minimum share of votes for a tree.
    """
    accepted: Bool = (vote(figures, forest)[:, 0] >= share) & ~too_few_voxels(figures)
    return accepted


_ABOUT = "Random forest of the package, extended with annotations."


@dataclass(frozen=True, slots=True)
class LearningResult:
    """A trained random forest with its scores.

    Attributes:
        data: JSON of the new forest, with its provenance.
        validated: Dict from each kind of sensor to the scores of the present and the new forest.
        things: Dict from the label of each class to the number of annotated objects.
        old_saw: Whether the present forest was trained with the same runs, so that its scores are optimistic.
        warnings: Messages about runs and annotations that could not be used.
    """

    data: dict[str, Any]
    validated: dict[str, Validation]
    things: dict[str, int]
    old_saw: bool
    warnings: list[str] = field(default_factory=list)


def learn(
    runs: Sequence[AnnotatedRun],
    in_force: Classification,
    folder: Path | None,
    *,
    seed: int = 0,
    progress: Progress = lambda _: None,
) -> LearningResult:
    """Extend the random forest of the package with the annotations of runs. Nothing is stored except the
    examples of the runs.

    Args:
        runs: The annotated runs. One that cannot be read is left out with a warning.
        in_force: The parameters in force, with the name of the present forest and its threshold.
        folder: Data folder, with the present forest and stored examples; None where there is none.
        seed: Random seed.
        progress: Called with progress messages.

    Raises:
        StemmapError: There are too few annotations or, for every kind of sensor, examples (the message names
            the numbers); or the present forest or stored examples cannot be read, or examples not be written.
    """
    if lacking := too_few(each.kind for run in runs for each in run.annotations):
        raise StemmapError(f"too few annotations: {lacking}")
    warnings: list[str] = []
    forests, share = Forests(folder), in_force.tree_share
    of_run = _examples(runs, folder and folder / "examples", progress, warnings)
    base, _ = read_forests(FILE, ALL_AROUND, ONE_WAY)
    grown, validated = dict[str, list[dict[str, Any]]](), dict[str, Validation]()
    things, used = Counter[str](), list[AnnotatedRun]()
    for kind in (ALL_AROUND, ONE_WAY):
        some = [(run, e) for run, e in of_run if e.all_around == (kind == ALL_AROUND) and len(e.label)]
        examples = [e for _, e in some]
        lacking = what_lacks(examples)
        if lacking:
            warnings += [f"sensors that see {kind}: {lacking}"] if examples else []
            continue
        progress("Scoring the present and the new forest")
        old = forests(in_force.forest, kind == ALL_AROUND)
        validated[kind] = validate(examples, base, kind, old, share, seed)
        progress("Training the new forest")
        figures, label = (
            np.concatenate([getattr(e, name) for e in examples]) for name in ("figures", "label")
        )
        grown |= all_expanded(base, kind, figures, label, object_numbers(examples), seed)
        things += things_by_class(examples)
        used += [run for run, _ in some]
    if not validated:
        reasons = [what_lacks([e for _, e in of_run]) if not warnings else "", *warnings]
        raise StemmapError("too few annotations: " + "; ".join(w for w in reasons if w))
    about = {
        "date": moment(time.time_ns()),
        "version": version(),
        "base": PACKAGE,
        "seed": seed,
        "runs": [{"name": run.name, "source": run.digest} for run in used],
        "things": dict(things),
        "against": in_force.forest,
        "share": share,
        "scores": {kind: asdict(each) for kind, each in validated.items()},
    }
    data = {**base, "about": _ABOUT, "learned": about, **grown}
    seen = () if in_force.forest == PACKAGE else seen_by(forests.read(in_force.forest))
    old_saw = any(run.digest in seen for run in used)
    return LearningResult(data, validated, dict(things), old_saw, warnings)


def seen_by(data: dict[str, Any]) -> tuple[str, ...]:
    """Return the digests of the runs with which a learned forest was trained, from its JSON; () for a forest
    without such a record."""
    learned = data.get("learned")
    runs = learned.get("runs") if isinstance(learned, dict) else None
    return tuple(str(run.get("source")) for run in runs or [] if isinstance(run, dict))


def things_by_class(examples: Sequence[Examples]) -> Counter[str]:
    """Return a Counter from the label of each class that occurs to its number of objects."""
    label = [int(k) for e in examples for k in e.label]
    of_thing = dict(zip(object_numbers(examples).tolist(), label, strict=True))
    return Counter(CLASSES[k].label for k in of_thing.values())


def too_few(kinds: Iterable[str]) -> str:
    """Return why there are too few objects of these kinds for a training: less than 10 trees or 5 others; ""
    where there are enough.

    Args:
        kinds: Kind of each object; all but "tree" count as others.
    """
    by_class = Counter(kinds)
    trees = by_class["tree"]
    others = by_class.total() - trees
    if trees >= LEAST_TREES and others >= LEAST_OTHERS:
        return ""
    needed = f"{LEAST_TREES} trees and {LEAST_OTHERS} other objects are needed"
    return f"{needed}; there are {count(trees, 'tree')} and {count(others, 'other object')}"


def what_lacks(examples: Sequence[Examples]) -> str:
    """Return why there are too few examples for a training and its scores; "" where there are enough."""
    if lacking := too_few(things_by_class(examples).elements()):
        return lacking
    if len(np.unique(groups_of(examples)[1])) < 2:
        return "all objects are within a metre of one another, so none can be left out for the scores"
    return ""


def _examples(
    runs: Sequence[AnnotatedRun], kept: Path | None, progress: Progress, warnings: list[str]
) -> list[tuple[AnnotatedRun, Examples]]:
    """Return the runs that can be mapped, each with its examples. A run that raises SourceError is left out
    with a warning. A run with annotations that have no column is kept with a warning. Damaged stored examples
    raise StemmapError.

    Args:
        runs: The runs.
        kept: Folder of stored examples; None stores nothing.
        progress: Called with progress messages.
        warnings: Warnings are appended to it.
    """
    found = []
    for run in runs:
        progress(f"Mapping {run.name}")
        try:
            examples = examples_of(run, kept, progress)
        except SourceError as error:
            warnings.append(f"{run.name} is left out: {error}")
            continue
        found.append((run, examples))
        lost = len(run.annotations) - len(np.unique(object_numbers([examples])))
        if lost:
            warnings.append(f"{run.name}: no column at {count(lost, 'annotation')}")
    return found


def table_lines(learned: LearningResult) -> list[str]:
    """Return lines of text: the number of objects by class; for each kind of sensor a heading and a table of
    TA, FR, TR and FA of the present ("old") and the new forest; and, if `old_saw`, a line that the scores of
    the present forest are optimistic."""
    classes = ", ".join(
        f"{n} {name}" for name, n in sorted(learned.things.items(), key=lambda item: -item[1])
    )
    lines = [f"trained with {count(sum(learned.things.values()), 'annotated object')}: {classes}"]
    for kind, each in learned.validated.items():
        lines += [
            f"sensors that see {kind}; {each.folds} folds, no {each.by} in two of them:",
            _row("", *("TA", "FR", "TR", "FA")),
            _row("old", *_cells(each.old)),
            _row("new", *_cells(each.new)),
        ]
    if learned.old_saw:
        lines.append("the scores of the old forest are optimistic: it was trained with these runs")
    return lines


def _cells(rates: Rates) -> list[str]:
    """Return TA, FR, TR and FA as text, in this order, see `rate_text`."""
    return [rate_text(rate) for rate in (rates.TA, rates.FR, rates.TR, rates.FA)]


def _row(*cells: str) -> str:
    """Return a row of the table as text: the first cell, left-aligned with a width of 5, and the others,
    right-aligned with a width of 18."""
    return "  " + cells[0].ljust(5) + "".join(cell.rjust(18) for cell in cells[1:])


class LearningRequest(msgspec.Struct, frozen=True):
    """Request for a training.

    Attributes:
        sources: The annotated runs.
        classification: Parameters of the classification in force, with the name of the present forest.
        folder: The data folder, where the new forest is stored.
        seed: Random seed.
    """

    sources: list[AnnotatedSource]
    classification: dict[str, Any]
    folder: str
    seed: int = 0


def train(request: LearningRequest, progress: Callable[[str], None]) -> dict[str, Any]:
    """Train a random forest, store it in `request.folder`, and return the result of `as_plain`. The
    parameters still name the present forest.

    Args:
        request: What is trained.
        progress: Called with progress messages.

    Raises:
        StemmapError: See `learn`, or the random forest cannot be stored.
    """
    folder, present = Path(request.folder), Classification.model_validate(request.classification)
    runs = [annotated_run(source) for source in request.sources]
    learned = learn(runs, present, folder, seed=request.seed, progress=progress)
    return as_plain(learned, Forests(folder).keep(learned.data), present.forest)


def as_plain(learned: LearningResult, name: str, old: str) -> dict[str, Any]:
    """Return the result for the dashboard as a dict of JSON values.

    The keys are `name`; `against`, the name `old`; `things`, a dict from each class to its number of objects;
    `old_saw`, whether the present forest was trained with the same runs, so that its scores are optimistic;
    `warnings`, the first 20; and `tables`, a list of a dict for each kind of sensor with `kind` and the
    fields of `Validation`.

    Args:
        learned: The result of `learn`.
        name: Name under which the new random forest is stored.
        old: Name of the present random forest.
    """
    return {
        "name": name,
        "against": old,
        "things": learned.things,
        "old_saw": learned.old_saw,
        "warnings": learned.warnings[:20],
        "tables": [{"kind": kind, **msgspec.to_builtins(each)} for kind, each in learned.validated.items()],
    }


def serve(parent: ParentConnection) -> None:
    """Run the program of the child process: receive one `LearningRequest`, send {"progress": text} messages
    and then {"learned": result of `train`}."""
    request = parent.receive(LearningRequest)
    parent.send({"learned": train(request, lambda text: parent.send({"progress": text}))})


if __name__ == "__main__":
    run_child(serve)
