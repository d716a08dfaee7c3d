"""Results of a benchmark: tables of figures as Markdown and JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

Cell = str | int | float | None


@dataclass(frozen=True, slots=True)
class Table:
    """Figures of one question.

    Attributes:
        title: What was measured, on what.
        columns: With units.
        rows: As long as `columns`; None is an empty cell.
        notes: Sentences below the table.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"{self.title}: {len(row)} cells for {len(self.columns)} columns")

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Table:
        """The inverse of `dataclasses.asdict` after a conversion to JSON and back."""
        return cls(
            value["title"],
            tuple(value["columns"]),
            tuple(tuple(row) for row in value["rows"]),
            tuple(value["notes"]),
        )

    def markdown(self) -> str:
        """The table with its title and notes."""
        texts = [list(self.columns), *([_text(cell) for cell in row] for row in self.rows)]
        widths = [max(len(row[k]) for row in texts) for k in range(len(self.columns))]
        right = [all(not isinstance(row[k], str) for row in self.rows) for k in range(len(self.columns))]
        rule = ["-" * (w - 1) + ":" if r else "-" * w for w, r in zip(widths, right, strict=True)]
        lines = [_line(row, widths, right) for row in [texts[0], rule, *texts[1:]]]
        notes = "".join(f"\n- {note}" for note in self.notes)
        return f"### {self.title}\n\n" + "\n".join(lines) + (f"\n{notes}" if notes else "")


def ratio(peer: float, ours: float) -> str:
    """Return the figure of the peer as a multiple of ours, e.g. "12.3x"."""
    return "-" if ours <= 0.0 else f"{_text(peer / ours)}x"


def verdict(reached: bool) -> str:
    """Whether a requirement is met, in words."""
    return "reached" if reached else "NOT reached"


def _line(row: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    cells = (t.rjust(w) if r else t.ljust(w) for t, w, r in zip(row, widths, right, strict=True))
    return "| " + " | ".join(cells) + " |"


def _text(cell: Cell) -> str:
    """Return a value with three significant digits, the precision of a shared machine."""
    if cell is None:
        return ""
    if isinstance(cell, float):
        if cell == 0.0:
            return "0"
        return f"{cell:,.0f}" if abs(cell) >= 100 else f"{cell:#.3g}".rstrip(".")
    return f"{cell:,}" if isinstance(cell, int) else cell
