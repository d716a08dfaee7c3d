"""Records of the store. Lengths are metres in the map frame, times nanoseconds since 1970."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from pipeline.errors import StemmapError

KINDS = ("tree", "pole", "person", "bush", "other")
MOST_ANNOTATIONS = 5000


MOST_SETS = 200


class StaleError(StemmapError):
    """An edit of an annotation that another person has changed in the meantime."""


class UnknownError(StemmapError):
    """The annotation, run or parameter set does not exist."""


@dataclass(frozen=True, slots=True)
class Content:
    """Content of an annotation.

    Attributes:
        x, y: Position [m].
        kind: Class, one of KINDS.
        dbh: Diameter at breast height [m], None if not measured.
    """

    x: float
    y: float
    kind: str = "tree"
    dbh: float | None = None


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
        who, at_ns: Author and time of the last edit.
        version: Number of edits.
    """

    id: int
    content: Content
    who: str
    at_ns: int
    version: int


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


def moment(at_ns: int) -> str:
    """Return a time as text with a resolution of one second."""
    return datetime.fromtimestamp(at_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
