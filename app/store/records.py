"""What the store keeps, as plain records. Lengths are metres in the frame of the map, times nanoseconds
since 1970."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from pipeline.errors import StemmapError

KINDS = ("tree", "pole", "person", "bush", "other")
MOST_ANNOTATIONS = 5000


MOST_SETS = 200


class StaleError(StemmapError):
    """An edit of something that somebody else has changed since."""


class UnknownError(StemmapError):
    """There is no such annotation or set."""


@dataclass(frozen=True, slots=True)
class Content:
    """What somebody says to stand somewhere.

    Attributes:
        x, y: [m].
        kind: One of KINDS.
        dbh: Diameter at breast height [m], None where nobody measured it.
    """

    x: float
    y: float
    kind: str = "tree"
    dbh: float | None = None


@dataclass(frozen=True, slots=True)
class Author:
    """Who makes an edit.

    Attributes:
        browser: Whose edits can be undone together: a made-up number of the browser.
        who: The name that others read.
    """

    browser: str
    who: str


@dataclass(frozen=True, slots=True)
class Annotation:
    """An annotation as it stands.

    Attributes:
        id: Stays for ever, also when it was deleted and came back.
        content: What is said.
        who, at_ns: The last edit.
        version: Grows by one with each edit.
    """

    id: int
    content: Content
    who: str
    at_ns: int
    version: int


@dataclass(frozen=True, slots=True)
class SavedSet:
    """Parameters that were saved under a name.

    Attributes:
        name: By which people know it; there is one of each.
        toml: The file that `--config` takes.
        who, at_ns: Who saved it last, and when.
    """

    name: str
    toml: str
    who: str
    at_ns: int


def moment(at_ns: int) -> str:
    """A time for people, to the second."""
    return datetime.fromtimestamp(at_ns // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
