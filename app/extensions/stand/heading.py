"""What a report names above its figures: the stand, the client and the author."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from app.batch.run_edits import recording_key
from app.store.records import Content

if TYPE_CHECKING:
    from app.store.store import Store

#: Class of the annotation that is the heading of a recording, with the fields of `Heading` as values.
HEADING = "heading"
LONGEST = 100  # characters of a field


@dataclass(frozen=True, slots=True)
class Heading:
    """Names on a report; an empty one is not printed.

    Attributes:
        stand: Name of the stand.
        client: Who ordered the report.
        author: Who made it.
    """

    stand: str = ""
    client: str = ""
    author: str = ""


def heading_of(contents: Iterable[Content]) -> Heading:
    """Return the last heading among annotations; an empty one if there is none."""
    values = [each.values for each in contents if each.kind == HEADING and each.values]
    return Heading(**values[-1]) if values else Heading()


def stored_heading(store: Store, source: Mapping[str, Any]) -> Heading:
    """Return the heading that a recording got on the page.

    Args:
        store: The store.
        source: Member `source` of run.json.
    """
    return heading_of(store.contents(recording_key(source), HEADING))
