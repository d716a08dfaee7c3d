"""Counts with their nouns."""

from __future__ import annotations

from app.common.text import count


def test_one_is_singular_and_thousands_are_grouped() -> None:
    assert [count(n, "scan") for n in (0, 1, 2, 12345)] == ["0 scans", "1 scan", "2 scans", "12,345 scans"]
    assert count(1, "entry", "entries") == "1 entry"
    assert count(3, "entry", "entries") == "3 entries"
