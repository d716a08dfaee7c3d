"""Learning: decision trees out of what people annotated, judged against those in force."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from app.common.text import count
from app.common.version import version
from app.training.annotated import things_of
from app.training.annotated_runs import AnnotatedRun, Progress, examples_of
from app.training.expanding import all_expanded
from app.training.fit_forest import Examples
from app.training.validating import Validated, groups_of, validate
from pipeline.classification.forest import (
    ALL_AROUND,
    CLASSES,
    FILE,
    ONE_WAY,
    PACKAGE,
    ForestOf,
    read_forests,
)
from pipeline.config.stages import Classification as GatheringParameters
from pipeline.errors import SourceError, StemmapError

LEAST_TREES, LEAST_OTHERS = 10, 5

_ABOUT = "Votes on what a column is: those of the package, which learned from annotations."


@dataclass(frozen=True, slots=True)
class Asked:
    """How to learn.

    Attributes:
        in_force: Names the forest that is learned against, and the share of votes that makes a tree.
        forests: Where it is found; seen: digests of the runs that it learned from.
        seed: Of every choice made at random; date: that is told with the trees.
        kept: Folder where examples are kept, for runs that were looked through before.
        progress: Told in words what is under way.
    """

    in_force: GatheringParameters
    forests: ForestOf
    seen: tuple[str, ...]
    seed: int
    date: str
    kept: Path | None
    progress: Progress = lambda _: None


@dataclass(frozen=True, slots=True)
class Learned:
    """What came of it.

    Attributes:
        data: JSON of the new decision trees, with where they come from.
        validated: Old against new, by the kind of sensor.
        things: That were learned from, by class; warnings: what could not be used, and why.
        old_saw: Whether the old trees have learned from the same runs, so that their figures flatter them.
    """

    data: dict[str, Any]
    validated: dict[str, Validated]
    things: dict[str, int]
    old_saw: bool
    warnings: list[str] = field(default_factory=list)


def learn(runs: Sequence[AnnotatedRun], asked: Asked) -> Learned:
    """Let the decision trees of the package learn what the annotations of runs say.

    Raises:
        StemmapError: There are too few examples, with how many of what are needed.
    """
    if lacking := too_few(each.kind for run in runs for each in run.annotations):
        raise StemmapError(f"too little was annotated to learn from: {lacking}")
    warnings: list[str] = []
    of_run = _gathered(runs, asked, warnings)
    base, _ = read_forests(FILE, ALL_AROUND, ONE_WAY)
    grown, validated = dict[str, list[dict[str, Any]]](), dict[str, Validated]()
    things, used = Counter[str](), list[AnnotatedRun]()
    for kind in (ALL_AROUND, ONE_WAY):
        some = [(run, e) for run, e in of_run if e.all_around == (kind == ALL_AROUND) and len(e.label)]
        examples = [e for _, e in some]
        lacking = what_lacks(examples)
        if lacking:
            warnings += [f"sensors that see {kind}: {lacking}"] if examples else []
            continue
        asked.progress("Judging old and new decision trees")
        old, share = asked.forests(asked.in_force.forest, kind == ALL_AROUND), asked.in_force.tree_share
        validated[kind] = validate(examples, base, kind, old, share, asked.seed)
        asked.progress("Growing the new decision trees")
        figures, label = (
            np.concatenate([getattr(e, name) for e in examples]) for name in ("figures", "label")
        )
        grown |= all_expanded(base, kind, figures, label, things_of(examples), asked.seed)
        things += things_by_class(examples)
        used += [run for run, _ in some]
    if not validated:
        told = [what_lacks([e for _, e in of_run]) if not warnings else "", *warnings]
        raise StemmapError("too little was annotated to learn from: " + "; ".join(w for w in told if w))
    about = {
        "date": asked.date,
        "version": version(),
        "base": PACKAGE,
        "seed": asked.seed,
        "runs": [{"name": run.name, "source": run.digest} for run in used],
        "things": dict(things),
        "against": asked.in_force.forest,
        "share": asked.in_force.tree_share,
        "scores": {kind: asdict(each) for kind, each in validated.items()},
    }
    data = {**base, "about": _ABOUT, "learned": about, **grown}
    old_saw = any(run.digest in asked.seen for run in used)
    return Learned(data, validated, dict(things), old_saw, warnings)


def seen_by(data: dict[str, Any]) -> tuple[str, ...]:
    """Digests of the runs that a learned forest tells to have learned from, out of its JSON."""
    learned = data.get("learned")
    runs = learned.get("runs") if isinstance(learned, dict) else None
    return tuple(str(run.get("source")) for run in runs or [] if isinstance(run, dict))


def things_by_class(examples: Sequence[Examples]) -> Counter[str]:
    """How many things of each class there are examples of."""
    label = [int(k) for e in examples for k in e.label]
    of_thing = dict(zip(things_of(examples).tolist(), label, strict=True))
    return Counter(CLASSES[k].label for k in of_thing.values())


def too_few(kinds: Iterable[str]) -> str:
    """Why things of these kinds are too few, "" when they are not."""
    by_class = Counter(kinds)
    trees = by_class["tree"]
    others = by_class.total() - trees
    if trees >= LEAST_TREES and others >= LEAST_OTHERS:
        return ""
    needed = f"{LEAST_TREES} trees and {LEAST_OTHERS} other things are needed"
    return f"{needed}; there are {count(trees, 'tree')} and {count(others, 'other thing')}"


def what_lacks(examples: Sequence[Examples]) -> str:
    """Why these examples are too few, "" when they are not."""
    if lacking := too_few(things_by_class(examples).elements()):
        return lacking
    if len(np.unique(groups_of(examples)[1])) < 2:
        return "all of them stand within a metre of one another, so nothing can be left out to judge by"
    return ""


def _gathered(
    runs: Sequence[AnnotatedRun], asked: Asked, warnings: list[str]
) -> list[tuple[AnnotatedRun, Examples]]:
    """The examples of each run that can be read."""
    found = []
    for run in runs:
        asked.progress(f"Looking through {run.name}")
        try:
            examples = examples_of(run, asked.kept, asked.progress)
        except SourceError as error:
            warnings.append(f"{run.name} is left out: {error}")
            continue
        found.append((run, examples))
        lost = len(run.annotations) - len(np.unique(things_of([examples])))
        if lost:
            warnings.append(f"{run.name}: nothing was gathered at {count(lost, 'annotation')}")
    return found
