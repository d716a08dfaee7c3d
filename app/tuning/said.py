"""What a search in a process of its own says to the dashboard that asked for it."""

from __future__ import annotations

import msgspec

from app.tuning.result import Result
from app.tuning.trial import Trial

FOLDER = "stemmap-search-"  # how the name of a journal's folder begins


class Said(msgspec.Struct, frozen=True, omit_defaults=True):
    """What a search says as it goes on.

    Attributes:
        start: Scores of the parameters to begin with; the search has begun.
        trials: That were made since the last word; with `start`, those of before it was stopped.
        result: What came of it; nothing follows.
        error: What, where and what to do; nothing follows.
    """

    start: Trial | None = None
    trials: tuple[Trial, ...] = ()
    result: Result | None = None
    error: tuple[str, str, str] | None = None
