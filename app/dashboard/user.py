"""Whose hand it is that changes something: the name that a person gave in the page.

It is a signature among people who trust one another and share a dashboard, not a login.
"""

from __future__ import annotations

import re
from contextvars import ContextVar
from urllib.parse import unquote

# It stands in tables that others open: no sign that a program there takes for a formula.
NAME = r"^[\w][\w .@-]{0,39}\Z"
SOMEBODY = "somebody"
COOKIE = "stemmap_name"

# Of the request that is being answered; empty where no request asked.
hand: ContextVar[str] = ContextVar("hand", default="")


def name_in(cookies: list[str]) -> str:
    """The name in the lines of a request's Cookie header; SOMEBODY where there is none that fits."""
    for line in cookies:
        for part in line.split(";"):
            name, _, value = part.strip().partition("=")
            if name == COOKIE and re.match(NAME, given := unquote(value)):
                return given
    return SOMEBODY
