"""Reads the provenance that a parameter file of a search has in its comments."""

from __future__ import annotations

import tomllib
from typing import Any


def provenance_in(text: str) -> dict[str, Any]:
    """Return the provenance that the comments of a parameter file hold; empty for other files."""
    lines = text.split("\n")[1:]
    remarks = []
    for line in lines:
        if not line.startswith("#"):
            break
        remarks.append(line.removeprefix("#").removeprefix(" "))
    try:
        return tomllib.loads("\n".join(remarks))
    except tomllib.TOMLDecodeError:
        return {}
