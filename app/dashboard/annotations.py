"""The annotations of the open run, and the ground truth that results from them and from the source."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from app.batch.run_edits import SAME_THING, reach_of
from app.batch.run_folder import TAPE_SIGMA
from app.store.async_store import AsyncStore
from app.store.records import (
    FRAME,
    KINDS,
    REPAIR,
    SKIPPED,
    Annotation,
    Author,
    Changed,
    Content,
    StaleError,
    as_truth,
)
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Float
from pipeline.repairs.record import GATE, Repair, identity_of, nearest_tree, numbers_at
from pipeline.repairs.trees import numbers_of, repaired_trees
from pipeline.types.records import Trees, TruthTrees

if TYPE_CHECKING:
    from app.store.store import Store

# Largest distance between an annotation and its row in an exported table [m], which has 0.1 mm.
SAME_PLACE = 0.001
# Two diameters are the same below this difference [m]: an exported table has 0.1 mm.
_SAME_DBH = 0.0001
# Of the difference between a diameter by tape and that of the map; a normal error is larger in 1 of 16,000
# trees.
_MOST_SIGMAS = 4.0
# [m]; a diameter beyond is often in another unit. They are used where the map has too few diameters.
_USUAL_DBH = (0.03, 1.5)
# Of n diameters of a stand, the next one lies outside their range with probability 2 / (n + 1): with this
# many, at most every fifth right one is asked about.
_FEWEST_DBH = 9

Against = Literal["both", "own", "annotations"]
Counted = Literal["none", "source", "annotations", "both"]


def truth_of(own: TruthTrees | None, rows: Sequence[Annotation], against: Against) -> TruthTrees | None:
    """Return the ground truth against which the map is scored; None where there is none, see `counted`.

    Args:
        own: Ground truth of the source, if any. It is not changed.
        rows: The annotations.
        against: "own" ignores the annotations, "annotations" the ground truth of the source; "both" applies
            the annotations to it.
    """
    used, contents = counted(own, rows, against), [row.content for row in rows]
    if used == "both":
        return laid_over(own, contents)
    if used == "annotations":
        return as_truth(contents)
    return own if used == "source" else None


def counted(own: TruthTrees | None, rows: Sequence[Annotation], against: Against) -> Counted:
    """Return which ground truth is used for the scores: "source" (chosen by `against` "own"), "annotations",
    "both" or "none"; arguments as in `truth_of`.

    "none" is returned if the chosen ground truth does not exist, except that without ground truth of the
    source "both" uses the annotations, and without annotations the source.
    """
    if own is None:
        return "annotations" if rows and against != "own" else "none"
    # A person who chose the annotations is not shown the ground truth of the source instead.
    if not rows and against == "annotations":
        return "none"
    if not rows or against == "own":
        return "source"
    return against


def laid_over(own: TruthTrees | None, contents: Sequence[Content]) -> TruthTrees | None:
    """Return the ground truth of the source with the annotations applied; None if there are neither. The
    objects of the source without an annotation come first, then all annotations.

    Annotations and objects are paired one to one within SAME_THING, see `pipeline.evaluation.match`. An
    annotation replaces its object. If both have the same class, the position of the object is used, and its
    diameter if the annotation has none. An annotation without an object is added.

    Args:
        own: Ground truth of the source, if any; it is not changed.
        contents: The annotations.
    """
    if not contents:
        return own
    if own is None or not len(own.x):
        return as_truth(contents)
    nearest = _nearest(own, contents)
    annotated = as_truth([_agreed(own, k, each) for k, each in zip(nearest.tolist(), contents, strict=True)])
    # An annotation replaces one object only; a neighbouring stem stays.
    keep = np.setdiff1d(np.arange(len(own.x)), nearest)
    return TruthTrees(
        np.concatenate([own.x[keep], annotated.x]),
        np.concatenate([own.y[keep], annotated.y]),
        np.concatenate([own.dbh[keep], annotated.dbh]),
        (*(own.kind[k] for k in keep), *annotated.kind),
    )


def contradicting(own: TruthTrees | None, rows: Sequence[Annotation]) -> list[int]:
    """Return the ids of the annotations whose class differs from that of their object of the source.

    Annotations and objects are matched one to one within SAME_THING, see `pipeline.evaluation.match`; the
    object of an annotation is therefore not always the nearest one. Annotations without an object do not
    count.

    Args:
        own: Ground truth of the source; None if there is none, then the result is [].
        rows: The annotations.
    """
    if own is None or not rows or not len(own.x):
        return []
    near = zip(_nearest(own, [row.content for row in rows]).tolist(), rows, strict=True)
    return [row.id for k, row in near if k >= 0 and own.kind[k] != row.content.kind]


def _agreed(own: TruthTrees, k: int, content: Content) -> Content:
    """Return the annotation; if the object of the source has the same class, a copy at the position of that
    object, with the DBH of the object if the annotation has no DBH and the object has one.

    Args:
        own: Ground truth of the source.
        k: Row of the object in it; -1 for none.
        content: The annotation.
    """
    if k < 0 or own.kind[k] != content.kind:
        return content
    known = float(own.dbh[k])
    dbh = content.dbh if content.dbh is not None or np.isnan(known) else known
    return replace(content, x=float(own.x[k]), y=float(own.y[k]), dbh=dbh)


def _nearest(own: TruthTrees, contents: Sequence[Content]) -> NDArray[np.int64]:
    """Return the row of the source for each annotation, shape (A,); -1 where none is within SAME_THING.

    A row belongs to one annotation at most, see `pipeline.evaluation.match`.
    """
    from pipeline.evaluation import match

    places = np.array([(content.x, content.y) for content in contents])
    return match(places, np.column_stack([own.x, own.y]), SAME_THING)


T = TypeVar("T")

_log = logging.getLogger(__name__)


class AnnotationEditor:
    """The annotations of the open run.

    Args:
        store: Access to the store.

    Attributes:
        run: Number of the run in the store, None while none is open.
        rows: The annotations of trees and other objects.
        skipped: The annotations of trees about which a person did not decide.
        others: The annotations of classes of extensions.
        frame: The annotation that is the reference system of the map; None for a local map.
        truth: Ground truth against which the map is scored.
        against: Choice of the ground truth, see `truth_of`.
        problem: Reason why nothing can be annotated; empty otherwise.
        changed: Called when the ground truth may have changed.
        edited: Called after an edit with its author and the number of annotations that it changed.
        serial: Number of edits so far, by which a page knows that its edit is shown.
    """

    def __init__(self, store: AsyncStore) -> None:
        self.run: int | None = None
        self._own: TruthTrees | None = None
        self.against: Against = "both"
        self._show([])
        self.problem = ""
        self.serial = 0
        self.changed: Callable[[], None] = lambda: None
        self.edited: Callable[[str, int], None] = lambda _who, _number: None
        self._store = store
        self._awaited: list[tuple[int, Author, Repair, Trees, tuple[int, ...]]] = []
        self._generation = 0  # grows whenever another run is opened or the run is left

    async def begin(self, source: str, uri: str, own: TruthTrees | None) -> None:
        """Read the annotations of a run that was opened; it is added to the store if necessary. Until they
        are read, `truth` is that of the source. An error of the store is stored in `problem`, and logged if
        it is new. If another run is opened meanwhile, the result is ignored. `changed` is not called.

        Args:
            source: Digest of the recording, or its URI if it has no digest.
            uri: URI with which it was opened.
            own: Ground truth of the source, if any.
        """
        self.leave()

        def work(store: Store) -> tuple[int, list[Annotation]]:
            run = store.open_run(source, uri, Path(uri).name[:200] or uri[:200])
            return run, store.annotations(run)

        self._own = self.truth = own
        generation = self._generation
        try:
            run, stored = await self._store.ask(work)
            if generation != self._generation:  # another run was opened meanwhile
                return
            self.run, self.problem = run, ""
            self._show(stored)
        except StemmapError as error:
            if generation != self._generation:
                return
            if str(error) != self.problem:
                _log.warning("%s", error)
            self.problem = str(error)

    def leave(self) -> None:
        """Forget the annotations, the ground truth and its choice, because the run was closed; the store does
        not change, and `changed` is not called."""
        self._generation += 1
        self.run, self._own, self.against = None, None, "both"
        self._awaited = []
        self._show([])

    def _show(self, stored: Sequence[Annotation]) -> None:
        """Set the annotations, sorted by kind, and the ground truth that results from them.

        Args:
            stored: All annotations of the run.
        """
        self.rows = [row for row in stored if row.content.kind in KINDS]
        self.skipped = [row for row in stored if row.content.kind == SKIPPED]
        self.others = [row for row in stored if row.content.kind not in (*KINDS, SKIPPED, FRAME)]
        self.frame = next((row for row in stored if row.content.kind == FRAME), None)
        self.truth = truth_of(self._own, self.rows, self.against)

    @property
    def in_truth(self) -> list[Content]:
        """The annotations that are objects of `truth`: its last ones, in this order."""
        return [row.content for row in self.rows] if self.used in ("annotations", "both") else []

    @property
    def used(self) -> Counted:
        """Ground truth that is used for the scores, see `counted`."""
        return counted(self._own, self.rows, self.against)

    def score_against(self, against: Against) -> None:
        """Choose the ground truth for the scores, see `truth_of`, and call `changed`. No annotation
        changes."""
        self.against = against
        self.truth = truth_of(self._own, self.rows, against)
        self.changed()

    @property
    def repairs(self) -> tuple[Repair, ...]:
        """The repairs of the map, in the order in which they were made."""
        rows = sorted((row for row in self.others if row.content.kind == REPAIR), key=lambda row: row.id)
        return tuple(msgspec.convert(row.content.values, Repair) for row in rows)

    def await_map(
        self, id_: int, author: Author, repair: Repair, trees: Trees, pair: tuple[int, ...]
    ) -> None:
        """Let the annotations follow the trees once the map has a repair of the path, see `follow`.

        Args:
            id_: Number of the annotation of the repair.
            author: Author of the repair.
            repair: The repair.
            trees: The trees before it.
            pair: Numbers of the trees that it ties.
        """
        self._awaited.append((id_, author, repair, trees, pair))

    async def follow(self, repairs: Sequence[Repair], trees: Trees) -> None:
        """Move the annotations of trees that awaited repairs of the path have moved, in the steps in which
        these were added. Errors are logged.

        Args:
            repairs: The repairs of a new map; awaited ones that are not among them stay awaited, unless they
                were removed.
            trees: Its trees.
        """
        if not self._awaited:
            return
        known = self.repairs
        there = [each for each in self._awaited if each[2] in repairs]
        self._awaited = [each for each in self._awaited if each not in there and each[2] in known]
        for id_, author, repair, before, pair in there:
            run = self.run
            moved = carried_along(before, trees, pair, [*self.rows, *self.skipped])
            if run is None or not moved or repair not in known:
                continue
            try:
                await self.edit(run, methodcaller("change_with", run, author, id_, moved))
            except StemmapError as error:
                _log.warning("the annotations do not follow the repair: %s", error)

    async def edit(self, run: int, function: Callable[[Store], T]) -> T:
        """Run an edit in the thread of the store, update the annotations, call `changed` (and `edited` if any
        of `rows` differs), and return the result of the edit.

        Args:
            run: Number of the run that is edited.
            function: The edit; it is called with the store.

        Raises:
            StaleError: Another run was opened meanwhile, or another person has changed the annotation; in the
                second case the annotations are updated, as after an edit.
            StemmapError: Nothing can be annotated, or the store refuses the edit; nothing changes.
        """
        if self.problem:
            raise StemmapError(self.problem)
        if run != self.run:
            raise StaleError(
                "another run was opened",
                remedy="Your edit was not saved; repeat it in the run that is open now",
            )
        generation = self._generation

        def work(store: Store) -> tuple[T | StaleError, list[Annotation]]:
            done: T | StaleError
            try:
                done = function(store)
            except StaleError as error:  # the current state is shown to the person
                done = error
            return done, store.annotations(run)

        done, stored = await self._store.ask(work)
        if generation == self._generation:  # else another run was opened meanwhile
            before = self.rows
            self._show(stored)
            who, number = _edits(before, self.rows)
            self.serial += 1
            self.changed()
            if number:
                self.edited(who, number)
        if isinstance(done, StaleError):
            raise done
        return done

    async def read(self, function: Callable[[Store, int], T]) -> T | None:
        """Return what a function returns for the store and the number of the run, called in the thread of the
        store; None if no run is open or nothing can be annotated. Raises StemmapError if the store cannot be
        used."""
        run = self.run
        if run is None or self.problem:
            return None
        return await self._store.ask(lambda store: function(store, run))

    def as_plain(self) -> dict[str, Any]:
        """Return the state for the dashboard as a dict of JSON values.

        The keys are `run`, `serial`, `problem` and `against`, the attributes; `used`, the result of
        `counted`; `own`, the number of objects in the ground truth of the source, None if there is none;
        `contradicting`, the result of this function; `same_thing_m`, SAME_THING; `doubt`, the constants of
        `is_doubtful_dbh` and `usual_dbh`, diameters in cm; `trees` and `skipped`, lists of `row_payload`;
        `others`, a dict from the class of each of `others` to a list of `values_payload`; `repairs`, the
        `identity_of` the repairs; and `frame`, the `values_payload` of `frame`, None for a local map.
        """
        return {
            "run": self.run,
            "serial": self.serial,
            "problem": self.problem,
            "used": self.used,
            "against": self.against,
            "own": None if self._own is None else len(self._own.x),
            "contradicting": contradicting(self._own, self.rows),
            "same_thing_m": SAME_THING,
            "doubt": {
                "sigmas": _MOST_SIGMAS,
                "tape_sigma_cm": 100.0 * TAPE_SIGMA,
                "usual_cm": [100.0 * limit for limit in _USUAL_DBH],
                "fewest": _FEWEST_DBH,
            },
            "trees": [row_payload(row) for row in self.rows],
            "skipped": [row_payload(row) for row in self.skipped],
            "others": {
                kind: [values_payload(row) for row in self.others if row.content.kind == kind]
                for kind in sorted({row.content.kind for row in self.others})
            },
            "repairs": identity_of(self.repairs),
            "frame": None if self.frame is None else values_payload(self.frame),
        }


def usual_dbh(mapped: Float) -> tuple[float, float]:
    """Return the least and the largest diameter of a map [m], of which some may be NaN; those of any stand if
    the map has fewer than _FEWEST_DBH."""
    known = mapped[np.isfinite(mapped)]
    return (float(known.min()), float(known.max())) if len(known) >= _FEWEST_DBH else _USUAL_DBH


def is_doubtful_dbh(dbh: float, mapped: float, sigma: float, usual: tuple[float, float]) -> bool:
    """Return whether a diameter by tape differs from that of the map, which may be NaN, by more than chance,
    or lies outside `usual` where the map has none [m]. Such a diameter is often in another unit."""
    if not math.isfinite(mapped):
        return not usual[0] <= dbh <= usual[1]
    known = sigma if math.isfinite(sigma) else 0.0
    return abs(dbh - mapped) > _MOST_SIGMAS * math.hypot(known, TAPE_SIGMA)


@dataclass(frozen=True, slots=True)
class ImportPlan:
    """What an import of a table does.

    Attributes:
        added: Contents of new annotations.
        filled, replaced: Id, version and new content of each annotation that gets a DBH, and of each one
            whose class or DBH is replaced.
        conflicts: The annotation and the row that contradicts it, of each row that is left out for that.
            Other contents have their authors.
        repeated: Number of rows that say nothing new.
        beside: Distance between row and annotation [m], of each row that is about an annotation but not at
            its place.
    """

    added: list[Content]
    filled: list[tuple[int, int, Content | None]]
    replaced: list[tuple[int, int, Content | None]]
    conflicts: list[tuple[Content, Content]]
    repeated: int
    beside: list[float]


def import_plan(
    rows: Sequence[Annotation],
    contents: Sequence[Content],
    *,
    name: str = "import",
    replaces: bool = False,
    has_diameters: bool = False,
) -> ImportPlan:
    """Return what an import of a table does.

    A row nearer to an annotation than `reach_of` it is about the same object, and adds no second one; only
    the nearest row is about it, so that two stems of a table stay two. A row at the place of an earlier row
    is about the object of that row. A row gives its DBH to an annotation of the same class without DBH. With
    another class or another DBH it is a conflict, and nothing is stored, unless it is the first row about an
    annotation and replaces it.

    Args:
        rows: The annotations of objects.
        contents: The rows of the table in the frame of the map, with the authors that it names.
        name: Author of what the table names no author of, or changes of an annotation whose author it names:
            a table that was saved here names those of the annotations before it was corrected.
        replaces: Whether a row replaces the class and the DBH of its annotation, as after a correction of an
            exported table elsewhere.
        has_diameters: Whether the table has a column of diameters: then a row without DBH that replaces
            removes the DBH of its annotation.
    """
    from scipy.spatial import cKDTree

    known = [*(row.content for row in rows), *contents]
    at = cKDTree(np.array([(each.x, each.y) for each in known]).reshape(-1, 2))
    same = _same_things(known, len(rows))
    object_of = {j: j for j in range(len(rows))} | {k: j for k, (j, _) in same.items()}
    filled, replaced, conflicts = set[int](), set[int](), list[tuple[Content, Content]]()
    named = set[int]()  # objects of earlier rows: only the first row about an annotation replaces it
    for k, content in enumerate(contents, start=len(rows)):
        if k not in same:
            near = at.query_ball_point((content.x, content.y), SAME_PLACE)
            objects = {object_of[j] for j in near if j in object_of}
            object_of[k] = min(objects, key=lambda j: (known[j].kind != content.kind, j), default=k)
        j = object_of[k]
        here = known[j]
        dbh = content.dbh if content.dbh is not None or (replaces and has_diameters) else here.dbh
        is_other_dbh = here.dbh is not None and (dbh is None or abs(here.dbh - dbh) > _SAME_DBH)
        before = {rows[j].who, rows[j].dbh_who} if j < len(rows) else set[str]()
        who, dbh_who = (
            name if not author or author in before else author
            for author in (content.who, content.dbh_who or content.who)
        )
        if j == k:
            known[j] = replace(here, who=who, dbh_who=dbh_who)
        elif here.kind != content.kind or is_other_dbh:
            if replaces and j < len(rows) and j not in named:
                known[j] = replace(here, kind=content.kind, dbh=dbh, who=who, dbh_who=dbh_who)
                replaced.add(j)
            else:
                conflicts.append((here, content))
        elif here.dbh is None and dbh is not None:
            known[j] = replace(here, dbh=dbh, who=here.who or who, dbh_who=dbh_who)
            filled.add(j)
        named.add(j)
    added = [known[j] for j in range(len(rows), len(known)) if object_of[j] == j]
    edits: list[list[tuple[int, int, Content | None]]] = [
        [(row.id, row.version, known[j]) for j, row in enumerate(rows) if j in of]
        for of in (filled - replaced, replaced)
    ]
    repeated = len(contents) - len(added) - len(filled | replaced) - len(conflicts)
    beside = [distance for _, distance in same.values() if distance > SAME_PLACE]
    return ImportPlan(added, edits[0], edits[1], conflicts, repeated, beside)


def _same_things(known: Sequence[Content], number: int) -> dict[int, tuple[int, float]]:
    """Return by the index of a row the index and the distance [m] of the annotation of the same object. The
    nearest pairs are found first, and at one place those of one class.

    Args:
        known: The annotations and the rows.
        number: Number of annotations, which come first.
    """
    from scipy.spatial import cKDTree

    places = np.array([(each.x, each.y) for each in known]).reshape(-1, 2)
    near = cKDTree(places[number:]).query_ball_tree(cKDTree(places[:number]), SAME_THING)
    pairs = [
        (max(math.dist(places[k], places[j]), SAME_PLACE), known[k].kind != known[j].kind, k, j)
        for k, annotations in enumerate(near, start=number)
        for j in annotations
        if math.dist(places[k], places[j]) < reach_of(known[j])
    ]
    same, taken = dict[int, tuple[int, float]](), set[int]()
    for distance, _, k, j in sorted(pairs):
        if k not in same and j not in taken:
            same[k] = j, distance
            taken.add(j)
    return same


def _trees_of(trees: Trees, rows: Sequence[Annotation]) -> dict[int, int]:
    """Return a dict from the id of each annotation that is about a tree to the number of this tree."""
    places = [(row.content.x, row.content.y) for row in rows]
    nearest = [nearest_tree(trees, place, confirmed=True) for place in places]
    return {
        row.id: int(trees.number[k])
        for row, place, k in zip(rows, places, nearest, strict=True)
        if k is not None and math.dist(place, trees.position[k]) < reach_of(row.content)
    }


def carried_by(
    trees: Trees, rows: Sequence[Annotation], repairs: Sequence[Repair]
) -> list[tuple[int, int, Content | None]]:
    """Return the changes of the annotations of trees that repairs move or merge: id, version and new content
    of each, see `Store.edit`.

    An annotation moves by as much as its tree. Of merged trees that both have an annotation, that of the tree
    that stays is kept, unless only the other one states a class; it gets the DBH of the other one if it has
    none and both are of one class. After a split, an annotation belongs to the nearer of both stems.

    Args:
        trees: The trees before the repairs.
        rows: The annotations of objects and skipped trees.
        repairs: The repairs, in their order; those of loops change nothing here.
    """
    contents = _authored(rows)
    tree_of = _trees_of(trees, rows)
    for repair in (repair for repair in repairs if not repair.is_of_loop):
        numbers, before = numbers_of(trees, repair), _places(trees)
        trees, problem = repaired_trees(trees, repair)
        if problem or not numbers:
            continue
        after, merged = _places(trees), repair.kind == "merge"
        if merged:
            contents |= _merged_contents(contents, tree_of, before, numbers)
        for id_, number in list(tree_of.items()):
            content, stays = contents[id_], numbers[0] if merged else number
            if content is None or number not in numbers or stays not in after:
                continue
            step = after[stays] - before[number]
            x, y = content.x + float(step[0]), content.y + float(step[1])
            contents[id_], tree_of[id_] = replace(content, x=x, y=y), stays
            if repair.kind == "split":
                tree_of[id_] = next(iter(numbers_at(trees, [(x, y)], confirmed=True)), stays)
    return [(row.id, row.version, contents[row.id]) for row in rows if contents[row.id] != row.content]


def carried_along(
    before: Trees, after: Trees, pair: Sequence[int], rows: Sequence[Annotation]
) -> list[tuple[int, int, Content | None]]:
    """Return the changes of the annotations of trees that a repair of the path moves or merges, as
    `carried_by`.

    Args:
        before, after, pair: As in `_successors`.
        rows: The annotations of objects and skipped trees.
    """
    contents = _authored(rows)
    tree_of = _trees_of(before, rows)
    old, new = _places(before), _places(after)
    stays = _successors(before, after, pair)
    for number, other in stays.items():
        if other != number and other in old:
            contents |= _merged_contents(contents, tree_of, old, (other, number))
    for id_, number in tree_of.items():
        content, at = contents[id_], stays.get(number)
        if content is not None and at is not None:
            x, y = (new[at] - old[number]).tolist()
            contents[id_] = replace(content, x=content.x + x, y=content.y + y)
    return [(row.id, row.version, contents[row.id]) for row in rows if contents[row.id] != row.content]


def _successors(before: Trees, after: Trees, pair: Sequence[int]) -> dict[int, int]:
    """Return the number after a repair of the path by the number of each tree that is known there: its own,
    or that of the tree with which it was merged.

    A repair moves what was seen at one time together. A merged tree is therefore the one that stands where it
    comes to with the known tree that was first seen next to it, from the time of the tied stem outwards.

    Args:
        before, after: The trees before and after the repair.
        pair: Numbers of the two tied stems; others are not known to be one.
    """
    old, new = _places(before), _places(after)
    first = dict(zip(before.number.tolist(), before.first_seen_ns.tolist(), strict=True))
    same = {number: number for number in old if number in new}
    stays, gone = [n for n in pair if n in new], [n for n in pair if n in old and n not in new]
    if len(stays) == len(gone) == 1:
        same[gone[0]] = stays[0]
    begin = first[gone[0]] if gone else 0
    for number in sorted(old.keys() - same.keys(), key=lambda n: abs(first[n] - begin)):
        if not same:
            break
        near = min(same, key=lambda n: abs(first[n] - first[number]))
        x, y = (old[number] + new[same[near]] - old[near]).tolist()
        if found := numbers_at(after, [(x, y)], confirmed=True):
            same[number] = found[0]
    return same


def _authored(rows: Sequence[Annotation]) -> dict[int, Content | None]:
    """Return by id the contents of annotations with their authors, which a repair does not change."""
    return {row.id: replace(row.content, who=row.who, dbh_who=row.dbh_who) for row in rows}


def _places(trees: Trees) -> dict[int, Float]:
    """Return the position of each tree by its number [m]."""
    return dict(zip(trees.number.tolist(), trees.position, strict=True))


def _merged_contents(
    contents: dict[int, Content | None],
    tree_of: dict[int, int],
    places: dict[int, Float],
    numbers: tuple[int, ...],
) -> dict[int, Content | None]:
    """Return the new contents of the annotations that count for two trees that are merged, see `carried_by`;
    none if one tree has no annotation.

    Args:
        contents: The annotations by their id.
        tree_of: Number of the tree of each.
        places: Positions of the trees before they are merged [m].
        numbers: Number of the tree that stays, and of the other one.
    """
    counting = list[tuple[int, Content]]()
    for number in numbers:
        found = [(id_, each) for id_, of in tree_of.items() if of == number and (each := contents[id_])]
        x, y = places[number].tolist()
        found.sort(key=lambda row: (row[1].kind == SKIPPED, math.hypot(row[1].x - x, row[1].y - y)))
        counting += found[:1]
    if len(counting) < 2:
        return {}
    (kept, content), (left, other) = sorted(counting, key=lambda row: row[1].kind == SKIPPED)
    if content.dbh is None and content.kind == other.kind:
        content = replace(content, dbh=other.dbh, dbh_who=other.dbh_who)
    return {kept: content, left: None}


def carried_back(repair: Repair, changes: Sequence[Changed]) -> list[tuple[int, int, Content | None]]:
    """Return the changes of annotations with which a repair is removed, see `Store.edit`: they return to the
    content before the repair, except for what was edited since.

    Args:
        repair: The repair.
        changes: Changes of annotations in the step that added it, see `Store.changed_with`; other repairs of
            that step may be the reason of some.
    """
    back = list[tuple[int, int, Content | None]]()
    for row, before, after in changes:
        # A tree is within GATE of its place in the repair, and an annotation within GATE of its tree.
        near = any(math.hypot(before.x - x, before.y - y) <= 2.0 * GATE for x, y in repair.places)
        if not near and not repair.is_of_loop:  # a repair of the path moves trees everywhere
            continue
        now = row.content
        content = before
        if after is not None:
            content = replace(
                now,
                x=now.x + before.x - after.x,
                y=now.y + before.y - after.y,
                dbh=before.dbh if now.dbh == after.dbh else now.dbh,
                who=row.who,
                dbh_who=before.dbh_who if now.dbh == after.dbh else row.dbh_who,
            )
        back.append((row.id, row.version, content))
    return back


def _edits(before: Sequence[Annotation], after: Sequence[Annotation]) -> tuple[str, int]:
    """Return the author of the newest edit ("" if annotations were only deleted) and the number of
    annotations that were added, changed or deleted between two states, by id and version."""
    old = {row.id: row.version for row in before}
    edited = [row for row in after if old.get(row.id) != row.version]
    deleted = len(old.keys() - {row.id for row in after})
    if not edited:
        return "", deleted
    return max(edited, key=lambda row: row.at_ns).by, len(edited) + deleted


def row_payload(row: Annotation) -> dict[str, Any]:
    """Return an annotation of an object as a dict of JSON values for the dashboard: `id`, `x` and `y` in the
    map [m], `kind`, `dbh_cm` (None if unknown), `reach_m` (see `reach_of`), the authors `who` and
    `dbh_who` ("" without a DBH) and that of the last edit (`by`), its time `at_s` [s since 1970], to the
    millisecond, and `version`."""
    content = row.content
    return {
        "id": row.id,
        "x": round(content.x, 4),
        "y": round(content.y, 4),
        "kind": content.kind,
        "dbh_cm": None if content.dbh is None else round(100.0 * content.dbh, 2),
        "reach_m": round(reach_of(content), 4),
        "who": row.who,
        "dbh_who": row.dbh_who,
        "by": row.by,
        "at_s": round(row.at_ns / 1e9, 3),
        "version": row.version,
    }


def values_payload(row: Annotation) -> dict[str, Any]:
    """Return an annotation with values as a dict of JSON values: the keys of `Content.values`, and `id`,
    `who`, `at_s` (time of the last edit [s since 1970]) and `version`."""
    return {
        "id": row.id,
        **(row.content.values or {}),
        "who": row.who,
        "at_s": row.at_ns // 1_000_000_000,
        "version": row.version,
    }
