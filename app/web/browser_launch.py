"""Opens the dashboard in the browser of who started it, without the token in the list of processes."""

from __future__ import annotations

import contextlib
import html
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="referrer" content="no-referrer">
<meta http-equiv="refresh" content="0;url={link}"><title>stemmap</title>
<p><a href="{link}">Open the dashboard</a></p></html>
"""


@contextlib.contextmanager
def page_that_leads_to(link: str) -> Iterator[Path]:
    """A file that only its owner can read and that leads a browser on to a link: what a program is
    called with, everybody on the machine can read. It is removed at the end."""
    number, name = tempfile.mkstemp(prefix="stemmap-", suffix=".html")  # readable by its owner only
    page = Path(name)
    try:
        with os.fdopen(number, "w", encoding="utf-8") as file:
            file.write(_PAGE.format(link=html.escape(link)))
        yield page
    finally:
        page.unlink(missing_ok=True)


def show_in_browser(page: Path) -> None:
    """Have the person's browser open a file; where there is none, nothing happens."""
    import webbrowser

    with contextlib.suppress(webbrowser.Error):
        webbrowser.open(page.as_uri())
