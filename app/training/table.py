"""Old and new decision trees side by side, in words."""

from __future__ import annotations

from app.common.text import count
from app.training.learning import Learned
from app.training.validating import Rates
from pipeline.evaluation import Rate


def table_lines(learned: Learned) -> list[str]:
    """The table of TA, TR, FA and FR for each kind of sensor, with what it was made from."""
    told = ", ".join(f"{n} {name}" for name, n in sorted(learned.things.items(), key=lambda item: -item[1]))
    lines = [f"learned from {count(sum(learned.things.values()), 'annotated thing')}: {told}"]
    for kind, each in learned.validated.items():
        lines += [
            f"sensors that see {kind}; {each.folds} parts, no {each.by} in two of them:",
            _row("", *("TA", "FR", "TR", "FA")),
            _row("old", *_cells(each.old)),
            _row("new", *_cells(each.new)),
        ]
    if learned.old_saw:
        lines.append("the old ones have learned from these runs, so their figures flatter them")
    return lines


def _cells(rates: Rates) -> list[str]:
    return [_cell(rate) for rate in (rates.TA, rates.FR, rates.TR, rates.FA)]


def _cell(rate: Rate) -> str:
    part = "-" if rate.rate is None else f"{100.0 * rate.rate:.1f} %"
    return f"{rate.count}/{rate.of} ({part})"


def _row(*cells: str) -> str:
    return "  " + cells[0].ljust(5) + "".join(cell.rjust(18) for cell in cells[1:])
