"""Numbers in text files: tables with one row per line, and plain sequences."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from itertools import islice, takewhile
from typing import IO

import numpy as np

from pipeline.types.records import Float

_BLOCK = 4 << 20  # bytes of text that are split into words at once, which takes ten times as much memory
_GAP = re.compile(rb"\s")
_LINES = 1 << 18  # read at once
_LINE_LIMIT = 1 << 16  # bytes; a longer line is cut, and its parts are damaged lines


def parse_numbers(text: bytes) -> Float:
    """Parse numbers between blanks or line ends up to the first word that is not a number; shape (N,)."""
    parts, at = [np.zeros(0)], 0
    while at < len(text):
        gap = _GAP.search(text, at + _BLOCK)
        end = len(text) if gap is None else gap.end()
        words = text[at:end].split()
        try:
            parts.append(np.array(words, np.float64))
        except ValueError:
            whole = list(takewhile(lambda numbers: numbers is not None, (_numbers([word]) for word in words)))
            parts.append(np.array(whole, np.float64).ravel())
            break
        at = end
    return np.concatenate(parts)


def parse_table(text: bytes, columns: int) -> tuple[Float, int]:
    """Parse lines of numbers separated by blanks.

    Empty lines are skipped. A line with another number of words, or with a word that is not a number, is
    damaged and left out; "nan" is a number.

    Args:
        text: ASCII.
        columns: Numbers per line.

    Returns:
        The numbers, float64 of shape (rows, columns), and how many lines are damaged.
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")
            table = np.loadtxt(io.BytesIO(text), comments=None, ndmin=2, encoding="latin1")
        if table.shape[1] == columns and table.size:
            return table, 0
    except ValueError:
        pass  # at least one line is damaged: find out which
    lines = [words for line in text.split(b"\n") if (words := line.split())]
    rows = [row for words in lines if len(words) == columns and (row := _numbers(words)) is not None]
    return np.array(rows, np.float64).reshape(-1, columns), len(lines) - len(rows)


def read_rows(file: IO[bytes], columns: int, lines: int) -> Iterator[Float]:
    """Yield the numbers of the next lines of a file part by part, each of shape (N, columns), N >= 1.

    Empty lines are skipped, and damaged lines are left out.

    Args:
        file: Open at the beginning of the first line.
        columns: Numbers per line.
        lines: How many lines are read, including damaged ones.
    """
    left = lines
    while left > 0:
        found = (line for line in iter(lambda: file.readline(_LINE_LIMIT), b"") if not line.isspace())
        block = list(islice(found, min(left, _LINES)))
        if not block:
            return
        left -= len(block)
        rows, _ = parse_table(b"".join(block), columns)
        if len(rows):
            yield rows


def _numbers(words: list[bytes]) -> list[float] | None:
    try:
        return [float(word) for word in words]
    except ValueError:
        return None
