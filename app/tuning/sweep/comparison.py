"""Results of a comparison side by side: a row per set and run, means over the runs, the best set for each
goal."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from app.tuning.sweep.jobs import Answer, SweepPlan

Figures = dict[str, float | int | None]

# Figure, heading, unit and factor from the stored value to the shown one.
SHOWN: tuple[tuple[str, str, str, float], ...] = (
    ("TA", "TA", "", 1.0),
    ("FR", "FR", "", 1.0),
    ("TR", "TR", "", 1.0),
    ("FA", "FA", "", 1.0),
    ("spurious", "spurious", "", 1.0),
    ("completeness", "compl.", "%", 100.0),
    ("correctness", "corr.", "%", 100.0),
    ("f1", "F1", "%", 100.0),
    ("position_rmse_m", "RMSE", "cm", 100.0),
    ("position_bias_m", "bias", "cm", 100.0),
    ("mean_pair_error_percent", "pairs", "%", 1.0),
)
COLUMNS = (
    "TA", "TA_of", "FR", "TR", "TR_of", "FA", "spurious", "completeness", "correctness", "f1",
    "position_rmse_m", "position_bias_m", "dbh_rmse_m", "dbh_bias_m", "mean_pair_error_percent",
    "scans", "trees",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Row:
    """The result of a set on one run, or its mean over all runs.

    Attributes:
        set_number: Number of the set, from 1 on.
        run: Number of the run, from 1 on; 0 for the mean.
        figures: Scores by name, see COLUMNS; empty for a failure.
        seconds: Computing time [s]; for a mean the sum.
        looked: Whether the front end ran in this time.
        error: Reason of the failure.
    """

    set_number: int
    run: int
    figures: Figures
    seconds: float = 0.0
    looked: bool = False
    error: str = ""


@dataclass(frozen=True, slots=True)
class Goal:
    """A criterion for the best set.

    Attributes:
        words: Its name.
        value: Value of a row's figures, larger is better; None where it is unknown.
    """

    words: str
    value: Callable[[Figures], tuple[float, ...] | None]


@dataclass(frozen=True, slots=True)
class Comparison:
    """All rows.

    Attributes:
        rows: By set and run.
        means: A row per set.
        best: Number of the best set by name of the goal; 0 where all sets are equal or unknown.
    """

    plan: SweepPlan
    rows: tuple[Row, ...]
    means: tuple[Row, ...]
    best: dict[str, int]

    @property
    def failed(self) -> list[Row]:
        """Rows without figures."""
        return [row for row in self.rows if row.error]


def _most(name: str) -> Callable[[Figures], tuple[float, ...] | None]:
    return lambda f: None if f[name] is None else (float(f[name] or 0.0),)


def _least(name: str) -> Callable[[Figures], tuple[float, ...] | None]:
    return lambda f: None if f[name] is None else (-float(f[name] or 0.0), float(f["f1"] or 0.0))


def _careful(f: Figures) -> tuple[float, ...] | None:
    wrong = float(f["FA"] or 0) + float(f["spurious"] or 0)
    return (-wrong, float(f["TA"] or 0))


GOALS = (
    Goal("F1", _most("f1")),
    Goal("completeness", _most("completeness")),
    Goal("fewest false trees, then most true ones", _careful),
    Goal("position RMSE", _least("position_rmse_m")),
    Goal("pair error", _least("mean_pair_error_percent")),
)


def compare_answers(plan: SweepPlan, answers: dict[tuple[int, int], Answer]) -> Comparison:
    """Return rows, means and the best sets."""
    rows, means = [], []
    for s in range(len(plan.sets)):
        of_set = [_row(plan, answers, s, r) for r in range(len(plan.runs))]
        rows += of_set
        means.append(_mean(s + 1, of_set))
    return Comparison(plan, tuple(rows), tuple(means), {goal.words: best_of(means, goal) for goal in GOALS})


def _row(plan: SweepPlan, answers: dict[tuple[int, int], Answer], s: int, r: int) -> Row:
    if (s, r) in plan.left_out:
        return Row(s + 1, r + 1, {}, error=plan.left_out[s, r])
    answer = answers[s, r]
    if answer.scores is None:
        return Row(s + 1, r + 1, {}, error=answer.error)
    return Row(s + 1, r + 1, figures(answer.scores), answer.seconds, answer.looked)


def figures(scores: dict[str, Any]) -> Figures:
    """Return the columns of a worker's scores."""
    columns: Figures = {name: scores[name]["count"] for name in ("TA", "FR", "TR", "FA")}
    columns["TA_of"], columns["TR_of"] = scores["TA"]["of"], scores["TR"]["of"]
    for name in COLUMNS:
        if name not in columns:
            columns[name] = scores[name.removesuffix("_m")]
    return columns


def _mean(set_number: int, rows: Sequence[Row]) -> Row:
    """Counts are summed over the runs; all other figures are means of the runs that have them, with equal
    weights. A set that failed on a run has no mean, because it could not be compared with the others."""
    failed = [row for row in rows if row.error]
    seconds = sum(row.seconds for row in rows)
    if failed:
        return Row(set_number, 0, {}, seconds, error=failed[0].error)
    mean: Figures = {}
    for name in COLUMNS:
        known = [value for row in rows if (value := row.figures[name]) is not None]
        if all(isinstance(value, int) for value in known) and known:
            mean[name] = sum(known)
        else:
            mean[name] = math.fsum(known) / len(known) if known else None
    return Row(set_number, 0, mean, seconds, any(row.looked for row in rows))


def best_of(means: Sequence[Row], goal: Goal) -> int:
    """Return the number of the best set, the first of equals; 0 where no value is known or all are equal."""
    values = [
        (value, -m.set_number) for m in means if m.figures and (value := goal.value(m.figures)) is not None
    ]
    equal = len(values) > 1 and max(values)[0] == min(values)[0]
    return -max(values)[1] if values and not equal else 0


def figure_words(figures: Figures, name: str, scale: float) -> str:
    """A figure as text; TA and TR with their totals."""
    value = figures[name]
    if value is None:
        return "-"
    if name in ("TA", "TR"):
        return f"{value}/{figures[f'{name}_of']}"
    return str(value) if isinstance(value, int) and scale == 1.0 else f"{scale * value:.2f}"


def is_valid(answer: Answer) -> bool:
    """Whether the scores of an answer have all figures, each a finite number or None; for a failure, whether
    it has a reason."""
    if answer.scores is None:
        return bool(answer.error)
    try:
        columns = figures(answer.scores)
    except (KeyError, TypeError):
        return False
    if any(columns[name] is None for name in ("TA", "TA_of", "FR", "TR", "TR_of", "FA", "spurious")):
        return False
    return math.isfinite(answer.seconds) and all(
        value is None or (type(value) in (int, float) and math.isfinite(value)) for value in columns.values()
    )
