"""Errors that are meant for people: what went wrong, where, and what to do about it."""

from __future__ import annotations


class StemmapError(Exception):
    """A failure that a person can act on. Its text is one line: `what (where). remedy`.

    Args:
        what: What went wrong, in one clause without a full stop.
        where: The file, topic, parameter or address it happened at; empty if `what` says it.
        remedy: What to do about it, one sentence; empty if nothing can be done.
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
    """A source that is no file and was mistyped: a scenario, option or scheme that does not exist."""


class ParameterError(StemmapError):
    """A parameter that does not exist, has the wrong type or lies out of its bounds."""
