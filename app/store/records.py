"""Records of the store. Lengths are metres in the map frame, times nanoseconds since 1970."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import StemmapError
from pipeline.types.records import TruthTrees

if TYPE_CHECKING:
    from app.sources.request import SourceRequest

KINDS = ("tree", "pole", "person", "bush", "other")
# Class of an annotation of a tree about which a person did not decide. It states nothing, so it is no
# ground truth, but it is stored, undone and shared like the others.
SKIPPED = "skipped"
# Class of the annotation that is the reference system of the map; a run has at most one.
FRAME = "frame"
# Class of an annotation that is a repair of the map, a `Repair` in `values`.
REPAIR = "repair"
MOST_ANNOTATIONS = 5000


MOST_SETS = 200


class StaleError(StemmapError):
    """An edit of an annotation that another person has changed in the meantime."""


class UnknownError(StemmapError):
    """The annotation, run or parameter set does not exist."""


class NoFilesError(StemmapError):
    """The run has no result files: it did not come to its end."""


@dataclass(frozen=True, slots=True)
class Content:
    """Content of an annotation.

    Attributes:
        x, y: Position in the map [m].
        kind: Class, one of KINDS, SKIPPED, FRAME or REPAIR, or that of an extension.
        dbh: Diameter at breast height [m], None if not measured.
        values: JSON values of a FRAME, with the record of a `MapFrame` as `frame`, of a REPAIR, with the
            fields of `Repair`, and of classes of extensions; None for KINDS and SKIPPED.
        reach: Distance below which a rejection can be about a mapped tree [m], because trees beyond were
            other ones when it was made; None if no other one was near, see `run_edits.reach_at`.
        who, dbh_who: Authors of a content that is stored and of its DBH, if they are not the author of the
            edit, as in an imported table; else empty. Contents that are read have theirs in `Annotation`.
    """

    x: float
    y: float
    kind: str = "tree"
    dbh: float | None = None
    values: dict[str, Any] | None = None
    reach: float | None = None
    who: str = field(default="", compare=False)
    dbh_who: str = field(default="", compare=False)


def contents_of(truth: TruthTrees) -> list[Content]:
    """Return the rows of a table of true trees and other objects as contents of annotations. The class is
    kept, also HIDDEN, which no annotation of a person has; a DBH of NaN becomes None."""
    columns = zip(truth.x.tolist(), truth.y.tolist(), truth.kind, truth.dbh.tolist(), strict=True)
    return [Content(x, y, kind, dbh if dbh == dbh else None) for x, y, kind, dbh in columns]


def as_truth(contents: Sequence[Content]) -> TruthTrees:
    """Return contents of annotations as a table of true trees; an unknown DBH becomes NaN."""
    return TruthTrees(
        np.array([c.x for c in contents], np.float64),
        np.array([c.y for c in contents], np.float64),
        np.array([np.nan if c.dbh is None else c.dbh for c in contents], np.float64),
        tuple(c.kind for c in contents),
    )


@dataclass(frozen=True, slots=True)
class Author:
    """Author of an edit.

    Attributes:
        browser: Random identifier of the browser, whose edits share one undo history.
        who: Name that other people see.
    """

    browser: str
    who: str


@dataclass(frozen=True, slots=True)
class Annotation:
    """Current version of an annotation.

    Attributes:
        id: Permanent identifier, also after a deletion was undone.
        content: Position, class and DBH.
        who: Author of the last edit that did more than to change the DBH.
        dbh_who: Author of the DBH; empty without one.
        by, at_ns: Author and time of the last edit.
        version: Number of edits.
    """

    id: int
    content: Content
    who: str
    dbh_who: str
    by: str
    at_ns: int
    version: int


# An annotation as it is now (of a deleted one, its last content), and its content before and after an earlier
# change; None is deleted.
Changed = tuple[Annotation, Content, Content | None]


@dataclass(frozen=True, slots=True)
class SavedSet:
    """A saved parameter set.

    Attributes:
        name: Unique name.
        toml: Content of a file for `--config`.
        who, at_ns: Author and time of the last save.
    """

    name: str
    toml: str
    who: str
    at_ns: int


@dataclass(frozen=True, slots=True)
class NewRun:
    """Start of a run: number of its source in the store, name, format, and the request that opened it."""

    run: int
    name: str
    kind: str
    request: SourceRequest


@dataclass(frozen=True, slots=True)
class RunFigures:
    """Current result of a run.

    Attributes:
        scans: Number of mapped scans.
        all_scans: Number of scans of the source, None if unknown.
        time_s: Time of the last mapped scan since the first [s].
        distance_m: Driven distance [m].
        lost: Share of the scans in which the pose was lost, from 0 to 1; None without a drive.
        trees: Number of confirmed trees.
        preset: Name of the preset.
        parameters: Dict from the dotted name of each parameter to its value.
        scores: Result of `score_payload`, or None.
        map: Dict with `trees`, `path`, `truth` and, of a live run, `recordings` and `logs`, lists of JSON
            values; and `warnings`.
    """

    scans: int
    all_scans: int | None
    time_s: float
    distance_m: float
    lost: float | None
    trees: int
    preset: str
    parameters: dict[str, Any]
    scores: dict[str, Any] | None
    map: dict[str, Any] = field(repr=False)


@dataclass(frozen=True, slots=True)
class Change:
    """A change of parameters by a person.

    Attributes:
        revision: Revision after the change.
        time_s: Time of the current scan [s since the first scan].
        who: Name of the person.
        preset: Name of the preset.
        changes: Dict from dotted names to [value before, value after].
    """

    revision: int
    time_s: float
    who: str
    preset: str
    changes: dict[str, list[Any]]


def moment(at_ns: int) -> str:
    """Return a time [ns since 1970] as text in whole seconds, for example "2026-11-26 06:00:00 UTC"."""
    return datetime.fromtimestamp(at_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
