"""Tables of numbers and words that people write: CSV with a header."""

from __future__ import annotations

import codecs
import csv
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from pipeline.errors import SourceError
from pipeline.geometry.poses import Float
from pipeline.io.readers.base import COORDINATE_LIMIT

_MOST_NAMED = 10  # faults of a table that are named


def refuse_faults(faults: Sequence[tuple[int, SourceError]]) -> None:
    """Raise one error that names the faults of a table, in the order of the rows: the first 10 and how many
    more there are. Return if there are none.

    Args:
        faults: Index of the row and error of each fault; its `what` names the line.

    Raises:
        SourceError: There is a fault. Remedies are those of the named faults.
    """
    errors = [error for _, error in sorted(faults, key=lambda fault: fault[0])]
    named, more = errors[:_MOST_NAMED], len(errors) - _MOST_NAMED
    if named:
        what = "; ".join([*(error.what for error in named), *([f"and {more} more"] if more > 0 else [])])
        remedies = dict.fromkeys(error.remedy for error in named if error.remedy)
        raise SourceError(what, where=named[0].where, remedy=". ".join(remedies))


def decoded(content: bytes) -> str:
    """Return the text of the bytes of a table: UTF-16 if it begins with a byte order mark of UTF-16, else
    UTF-8 if it is valid, with or without a mark, else Windows-1252.

    Raises:
        UnicodeDecodeError: The bytes are none of these, or contain a zero byte (except in UTF-16).
    """
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16")
    if (zero := content.find(0)) >= 0:
        raise UnicodeDecodeError("utf-8", content, zero, zero + 1, "zero byte")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252")


class CsvTable:
    """A table with a header line, separated by commas, semicolons or tabs, whichever is most frequent in the
    first line. With semicolons, numbers may have decimal commas.

    Args:
        text: The text.
        what: Name of the kind of table for errors, e.g. "table of trees".
        where: Name of the table in errors.

    Attributes:
        lines: List of the line numbers, from 1, of the rows in the file.
        rows: List of the rows with a cell that is not empty, each a list of its cells, without the header.
        column: Dict from names of columns in lower case to their indices; of several columns with the same
            name, the first one.

    Raises:
        SourceError: The text is not a CSV.
    """

    def __init__(self, text: str, what: str, where: str) -> None:
        self.where = where
        delimiter = max(",;\t", key=text.partition("\n")[0].count)
        self._has_semicolons = delimiter == ";"
        try:
            reader = csv.reader(text.splitlines(), delimiter=delimiter)
            numbered = [(reader.line_num, row) for row in reader if any(row)]
        except csv.Error as error:
            raise SourceError(f"the {what} is not a CSV: {error}", where=where) from None
        header = [name.strip().lower() for name in numbered[0][1]] if numbered else []
        self.lines, self.rows = [line for line, _ in numbered[1:]], [row for _, row in numbered[1:]]
        self.column: dict[str, int] = {}
        for k, name in enumerate(header):
            self.column.setdefault(name, k)

    @classmethod
    def read(cls, path: Path, what: str, largest: int) -> CsvTable:
        """Return the table of a file; `what` names it in errors.

        Raises:
            SourceError: The file cannot be read, is larger than `largest` bytes, is not text (`decoded`), or
                is not a CSV.
        """
        try:
            if path.stat().st_size > largest:
                raise SourceError(f"the {what} is larger than {largest >> 20} MB", where=str(path))
            content = path.read_bytes()
        except OSError as error:
            raise SourceError(f"cannot read the {what}: {error.strerror}", where=str(path)) from None
        try:
            text = decoded(content)
        except UnicodeDecodeError:
            raise SourceError(f"the {what} is not text", where=str(path)) from None
        return cls(text, what, str(path))

    def find(self, names: Iterable[str]) -> str | None:
        """Return the first of some names, in lower case, that is a column; None if none is."""
        return next((name for name in names if name in self.column), None)

    def text(self, name: str) -> list[str]:
        """Return the stripped cells of a column, "" where a row is too short or there is no such column."""
        k = self.column.get(name, -1)
        return [row[k].strip() if 0 <= k < len(row) else "" for row in self.rows]

    def numbers(
        self, name: str, *, required: bool = True, faults: dict[int, SourceError] | None = None
    ) -> Float:
        """Return the numbers of a column, shape (N,). If `required` is False, empty cells, "nan" and "na"
        (also in capitals) give NaN. A column that the table does not have counts as empty cells. In a column
        of a table with semicolons in which a cell has a comma, the comma is the decimal sign and a point is
        an error, because it may separate thousands.

        Args:
            name: Name of the column.
            required: Whether an unknown number is an error.
            faults: If given, the error of a cell is added by the index of its row, unless the row has one,
                and the number is NaN.

        Raises:
            SourceError: A cell is not a finite number, or its magnitude is not less than COORDINATE_LIMIT.
        """
        texts = self.text(name)
        has_commas = self._has_semicolons and any("," in text for text in texts)
        found = []
        for k, text in enumerate(texts):
            try:
                found.append(self._number(text, name, k, required, has_commas))
            except SourceError as error:
                if faults is None:
                    raise
                faults.setdefault(k, error)
                found.append(math.nan)
        return np.array(found, np.float64)

    def _number(self, text: str, name: str, row: int, required: bool, has_commas: bool) -> float:
        """Return the number of one cell, with the errors of `numbers`.

        Args:
            text: The cell.
            name, row: Name of the column and index of the row, for errors.
            required: Whether an unknown number is an error.
            has_commas: Whether the decimal sign is a comma, see `numbers`.
        """
        if text == "" and not required:
            return math.nan
        is_ambiguous = has_commas and "." in text
        try:
            value = math.nan if is_ambiguous else float(text.replace(",", ".") if has_commas else text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) and (required or text.lower() not in ("nan", "na")):
            raise SourceError(
                f"line {self.lines[row]}: {name} = {text!r} is not a number",
                where=self.where,
                remedy="Write one decimal sign in all rows, and no sign between thousands"
                if is_ambiguous
                else "",
            )
        if abs(value) >= COORDINATE_LIMIT:
            raise SourceError(
                f"line {self.lines[row]}: {name} = {text!r} is out of range",
                where=self.where,
                remedy=f"Give numbers between -{COORDINATE_LIMIT:,.0f} and {COORDINATE_LIMIT:,.0f}",
            )
        return value
