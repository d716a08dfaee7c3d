"""Words for people."""

from __future__ import annotations

COMPILING = "compiling for this machine; it takes some minutes the first time, less for a new kind of source"


def count(n: int, one: str, many: str = "") -> str:
    """A number with its noun: "1 scan", "1,200 scans", "2 spans of scans".

    Args:
        one: The noun; many: its plural where that is not one with an s.
    """
    return f"{n:,} {one if n == 1 else many or f'{one}s'}"
