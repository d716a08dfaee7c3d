"""A comparison as text for a terminal, as tables and as a web page.

Times are in a file of their own, so that the tables and the JSON have the same bytes for the same runs and
parameters, wherever they were computed.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from app.common.text import count
from app.common.version import version
from app.tuning.sweep.comparison import COLUMNS, SHOWN, Comparison, Row, figure_words
from app.tuning.sweep.grid import words_of
from app.tuning.sweep.report_html import page
from pipeline.io.atomic_files import write_beside

MOST_LINES = 60
_COMPUTED = ("=", "+", "-", "@", "\t", "\r")


def lines(comparison: Comparison) -> list[str]:
    """Return a table with a row per set, preceded by the rows of its runs if they are few, and the best
    sets."""
    plan = comparison.plan
    one = len(plan.runs) == 1
    rows: list[Row] = []
    for mean in comparison.means:
        of_set = [row for row in comparison.rows if row.set_number == mean.set_number]
        rows += of_set if one else [*of_set, mean]
    notes = []
    if len(rows) > MOST_LINES and not one:
        rows = list(comparison.means)
    if len(rows) > MOST_LINES:
        left_out = len(rows) - MOST_LINES
        rows = sorted(rows, key=lambda row: -(row.figures.get("f1") or -1.0))[:MOST_LINES]
        notes.append(f"{count(left_out, 'set')} with a smaller F1 not shown; --out DIR writes all of them")
    heads = ["set", "parameters", *([] if one else ["run"]), *(_head(h, u) for _, h, u, _ in SHOWN), "s"]
    cells = [_cells(comparison, row, one=one) for row in rows]
    return [*_aligned([heads, *cells]), *notes, *_best_lines(comparison)]


def files(comparison: Comparison, folder: Path) -> list[str]:
    """Write results.csv, means.csv, results.json, times.csv and report.html, and return their names.

    Raises:
        StemmapError: A file cannot be written. Each file is complete or unchanged.
    """
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "results.csv": _table(comparison, comparison.rows),
        "means.csv": _table(comparison, comparison.means),
        "results.json": json_text(comparison),
        "times.csv": _times(comparison),
        "report.html": page(comparison),
    }
    for name, text in texts.items():
        with write_beside(folder / name) as partial:
            partial.write_text(text, encoding="utf-8")
    return list(texts)


def json_text(comparison: Comparison) -> str:
    """Return everything but the times as JSON."""
    plan = comparison.plan
    record: dict[str, Any] = {
        "stemmap": version(),
        "runs": [
            {
                "run": k + 1,
                "name": run.name,
                "sha256": run.run.digest,
                "seed": run.run.source.seed,
                "odometry": run.run.source.odometry,
                "true_trees": sum(kind == "tree" for kind in run.run.truth.kind),
            }
            for k, run in enumerate(plan.runs)
        ],
        "sets": [{"set": k + 1, "parameters": changes} for k, changes in enumerate(plan.sets)],
        "results": [_record(row) for row in comparison.rows],
        "means": [_record(row) for row in comparison.means],
        "best": comparison.best,
    }
    return json.dumps(record, indent=1) + "\n"


def _record(row: Row) -> dict[str, Any]:
    numbers = {"set": row.set_number, **({"run": row.run} if row.run else {})}
    if row.error:
        return {**numbers, "error": row.error}
    return {**numbers, **{name: row.figures[name] for name in COLUMNS}}


def _table(comparison: Comparison, rows: Sequence[Row]) -> str:
    plan = comparison.plan
    axes = list(plan.sets[0]) if plan.sets else []
    of_runs = any(row.run for row in rows)
    head = ["set", *axes, *(["run", "source"] if of_runs else []), *COLUMNS, "error"]
    return _csv(
        head,
        (
            [
                row.set_number,
                *(plan.sets[row.set_number - 1][axis] for axis in axes),
                *([row.run, plan.runs[row.run - 1].name] if of_runs else []),
                *(row.figures.get(name) for name in COLUMNS),
                row.error,
            ]
            for row in rows
        ),
    )


def _times(comparison: Comparison) -> str:
    rows = ([r.set_number, r.run, f"{r.seconds:.3f}", r.looked] for r in comparison.rows if not r.error)
    return _csv(["set", "run", "seconds", "scans_looked_at"], rows)


def _csv(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(head)
    for row in rows:
        table.writerow([_cell(cell) for cell in row])
    return text.getvalue()


def _cell(cell: object) -> object:
    """A cell as it is written. A text that a spreadsheet would compute, such as a file name `=1+1.mcap`, gets
    an apostrophe in front."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return str(cell).lower()
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(_COMPUTED) else cell


def _head(heading: str, unit: str) -> str:
    return f"{heading} {unit}".strip()


def _cells(comparison: Comparison, row: Row, *, one: bool) -> list[str]:
    plan = comparison.plan
    first = [str(row.set_number), words_of(plan.sets[row.set_number - 1])]
    if not one:
        first.append(plan.runs[row.run - 1].name if row.run else "mean")
    if row.error:
        return [*first, f"failed: {row.error}"]
    return [
        *first,
        *(figure_words(row.figures, name, scale) for name, _, _, scale in SHOWN),
        f"{row.seconds:.1f}",
    ]


def _aligned(rows: list[list[str]]) -> list[str]:
    whole = [row for row in rows if len(row) == len(rows[0])]
    width = [max(len(row[k]) for row in whole) for k in range(len(rows[0]))]
    words = len(rows[0]) - len(SHOWN) - 1  # columns of text, aligned left; figures are aligned right
    return [
        "  ".join(
            cell.ljust(width[k]) if k < words else cell.rjust(width[k]) if len(row) == len(rows[0]) else cell
            for k, cell in enumerate(row)
        ).rstrip()
        for row in rows
    ]


def _best_lines(comparison: Comparison) -> list[str]:
    lines = []
    for goal, number in comparison.best.items():
        if number:
            lines.append(f"best {goal}: set {number} ({words_of(comparison.plan.sets[number - 1])})")
        elif len(comparison.plan.sets) > 1:
            lines.append(f"best {goal}: none; all sets are equal or unknown")
    return lines
