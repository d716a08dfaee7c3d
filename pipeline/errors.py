"""Errors with messages for users: what went wrong, where, and how to correct it."""

from __future__ import annotations


class StemmapError(Exception):
    """An error that a user can act on. Its message is one line: `what (where). remedy`.

    Args:
        what: What went wrong, in one clause without a full stop.
        where: File, topic, parameter or address at which it happened; empty if `what` contains it.
        remedy: How to correct it, one sentence; empty if nothing can be done.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        self.what = what
        self.where = where
        self.remedy = remedy
        place = f" ({where})" if where else ""
        advice = f". {remedy}" if remedy else ""
        super().__init__(f"{what}{place}{advice}")


class SourceError(StemmapError):
    """A recording, folder, scenario or live address that cannot be read."""


class UsageError(SourceError):
    """A source argument that is not a file and is not valid: an unknown scenario, option or scheme."""


class ParameterError(StemmapError):
    """A parameter that does not exist, has the wrong type or is out of its bounds."""
