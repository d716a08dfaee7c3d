"""Numbers written as text, read in one compiled pass; nothing in the text is believed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.jit import compiled
from pipeline.types.records import Float

_POWERS: Float = 10.0 ** np.arange(23, dtype=np.float64)


def parse_numbers(text: bytes | memoryview, limit: int | None = None) -> Float:
    """Decimal numbers separated by blanks, commas, tabs or line ends, float64 of shape (N,).

    "nan" gives NaN. Reading stops at the first word that is no number, so a cut or damaged text
    gives the numbers before the damage.

    Args:
        text: ASCII.
        limit: Read at most so many numbers.
    """
    buffer = np.frombuffer(text, dtype=np.uint8)
    most = len(buffer) // 2 + 1
    numbers = np.empty(most if limit is None else min(most, limit), dtype=np.float64)
    return numbers[: _parse(buffer, numbers, _POWERS)]


def rows_of(text: bytes | memoryview, width: int, limit: int) -> tuple[int, int]:
    """How many lines of `width` words a text begins with, empty ones aside, and the words of the line after.

    Args:
        text: ASCII; width: of a row; limit: count at most so many rows.

    Returns:
        The rows, and how many words stand in the first line that is none; 0 where there is no such line.
    """
    rows, words = _rows(np.frombuffer(text, dtype=np.uint8), width, limit)
    return int(rows), int(words)


@compiled
def _rows(buffer: NDArray[np.uint8], width: int, limit: int) -> tuple[int, int]:
    rows, words, at, size = 0, 0, 0, len(buffer)
    before = True  # whether a gap stands before this letter
    while at <= size and rows < limit:
        if at == size or buffer[at] == 10:
            if words != 0 and words != width:
                return rows, words
            rows += words != 0
            words = 0
            before = True
        else:
            gap = _is_gap(buffer[at])
            words += before and not gap
            before = gap
        at += 1
    return rows, 0


@compiled
def _is_gap(letter: int) -> bool:
    return letter == 32 or letter == 44 or 9 <= letter <= 13


@compiled
def _parse(buffer: NDArray[np.uint8], numbers: Float, powers: Float) -> int:
    at, found, size = 0, 0, len(buffer)
    while found < len(numbers):
        while at < size and _is_gap(buffer[at]):
            at += 1
        if at >= size:
            break
        end = at
        while end < size and not _is_gap(buffer[end]):
            end += 1
        number, sound = _word(buffer, at, end, powers)
        if not sound:
            break
        numbers[found] = number
        found += 1
        at = end
    return found


@compiled
def _word(buffer: NDArray[np.uint8], at: int, end: int, powers: Float) -> tuple[float, bool]:
    """One number and whether the word is one."""
    negative = buffer[at] == 45
    if negative or buffer[at] == 43:
        at += 1
    if (
        end - at == 3
        and (buffer[at] | 32) == 110
        and (buffer[at + 1] | 32) == 97
        and (buffer[at + 2] | 32) == 110
    ):
        return np.nan, True
    mantissa, digits, shift = 0.0, 0, 0
    point = False
    while at < end and (48 <= buffer[at] <= 57 or (buffer[at] == 46 and not point)):
        if buffer[at] == 46:
            point = True
        else:
            digits += 1
            # Sixteen digits fill a double; what comes after them only moves the point.
            if mantissa < 1e15:
                mantissa = mantissa * 10.0 + (buffer[at] - 48)
                shift -= 1 if point else 0
            else:
                shift += 0 if point else 1
        at += 1
    if digits == 0:
        return 0.0, False
    if at < end and (buffer[at] | 32) == 101:
        at += 1
        down = at < end and buffer[at] == 45
        if at < end and (buffer[at] == 45 or buffer[at] == 43):
            at += 1
        exponent, digits = np.int64(0), 0
        while at < end and 48 <= buffer[at] <= 57 and digits < 6:
            exponent = exponent * 10 + np.int64(buffer[at] - 48)
            digits += 1
            at += 1
        if digits == 0:
            return 0.0, False
        shift += int(-exponent if down else exponent)
    if at < end:
        return 0.0, False
    if 0 <= shift <= 22:
        mantissa *= powers[shift]
    elif -22 <= shift < 0:
        mantissa /= powers[-shift]
    else:
        mantissa *= 10.0 ** np.float64(shift)
    return (-mantissa if negative else mantissa), True
