"""The name that a person entered in the page, and the person whose request is being handled.

The name is a signature among people who trust one another and share a dashboard, not a login.
"""

from __future__ import annotations

import re
from contextvars import ContextVar
from urllib.parse import unquote

# The name appears in tables that others open: its first character must not start a formula there.
USER_NAME = r"^[\w][\w .@-]{0,39}\Z"
SOMEBODY = "somebody"
COOKIE = "stemmap_name"

# Name of the person whose request or scene message is being handled; empty outside of both.
current_user: ContextVar[str] = ContextVar("current_user", default="")


def user_of_cookies(cookies: list[str]) -> str:
    """Return the name of the person in the Cookie headers of a request: the first valid value of COOKIE;
    SOMEBODY without one.

    Args:
        cookies: Values of the headers.
    """
    for line in cookies:
        for part in line.split(";"):
            name, _, value = part.strip().partition("=")
            if name == COOKIE and is_user_name(given := unquote(value)):
                return given
    return SOMEBODY


def is_user_name(name: str) -> bool:
    """Return whether a name has 1 to 40 letters (of any script), digits, spaces and . @ - _ and begins with a
    letter, a digit or _."""
    return re.match(USER_NAME, name) is not None
