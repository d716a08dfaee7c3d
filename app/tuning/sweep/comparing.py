"""What came of sets and runs side by side: a row each, the means over the runs, the best for each goal."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from app.tuning.sweep.asking import Plan
from app.tuning.sweep.jobs import Answer

Figures = dict[str, float | int | None]

# Figure, its heading, unit and what it is multiplied with for people.
SHOWN: tuple[tuple[str, str, str, float], ...] = (
    ("TA", "TA", "", 1.0),
    ("FR", "FR", "", 1.0),
    ("TR", "TR", "", 1.0),
    ("FA", "FA", "", 1.0),
    ("spurious", "none", "", 1.0),
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
    """A set on a run, or on the mean of all of them.

    Attributes:
        set_number: From 1 on.
        run: Its number from 1 on, 0 for the mean.
        figures: By name, see COLUMNS; empty where it failed.
        seconds: That it took; of a mean their sum.
        looked: Whether scans had to be looked at in this time.
        error: Why there are no figures.
    """

    set_number: int
    run: int
    figures: Figures
    seconds: float = 0.0
    looked: bool = False
    error: str = ""


@dataclass(frozen=True, slots=True)
class Goal:
    """What a set may be best at.

    Attributes:
        words: For people.
        value: Of a row's figures, the larger the better; None where it cannot be said.
    """

    words: str
    value: Callable[[Figures], tuple[float, ...] | None]


@dataclass(frozen=True, slots=True)
class Comparison:
    """All rows.

    Attributes:
        rows: By set and run.
        means: A row a set.
        best: Number of the best set by goal, in words; 0 where none is better than others.
    """

    plan: Plan
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


def compared(plan: Plan, answers: dict[tuple[int, int], Answer]) -> Comparison:
    """Rows, means and the best."""
    rows, means = [], []
    for s in range(len(plan.sets)):
        of_set = [_row(plan, answers, s, r) for r in range(len(plan.runs))]
        rows += of_set
        means.append(_mean(s + 1, of_set))
    return Comparison(plan, tuple(rows), tuple(means), {goal.words: best_of(means, goal) for goal in GOALS})


def _row(plan: Plan, answers: dict[tuple[int, int], Answer], s: int, r: int) -> Row:
    if (s, r) in plan.left_out:
        return Row(s + 1, r + 1, {}, error=plan.left_out[s, r])
    answer = answers[s, r]
    if answer.scores is None:
        return Row(s + 1, r + 1, {}, error=answer.error)
    return Row(s + 1, r + 1, figures(answer.scores), answer.seconds, answer.looked)


def figures(scores: dict[str, Any]) -> Figures:
    """The columns from what a worker answered."""
    told: Figures = {name: scores[name]["count"] for name in ("TA", "FR", "TR", "FA")}
    told["TA_of"], told["TR_of"] = scores["TA"]["of"], scores["TR"]["of"]
    for name in COLUMNS:
        if name not in told:
            told[name] = scores[name.removesuffix("_m")]
    return told


def _mean(set_number: int, rows: Sequence[Row]) -> Row:
    """Counts are added up over the runs; all else is the mean of the runs that can tell it, each as weighty
    as the others. A set that failed on a run has no mean: it would not be that of the same runs."""
    failed = [row for row in rows if row.error]
    seconds = sum(row.seconds for row in rows)
    if failed:
        return Row(set_number, 0, {}, seconds, error=failed[0].error)
    told: Figures = {}
    for name in COLUMNS:
        known = [value for row in rows if (value := row.figures[name]) is not None]
        if all(isinstance(value, int) for value in known) and known:
            told[name] = sum(known)
        else:
            told[name] = math.fsum(known) / len(known) if known else None
    return Row(set_number, 0, told, seconds, any(row.looked for row in rows))


def best_of(means: Sequence[Row], goal: Goal) -> int:
    """The first of the best, 0 where no set tells or several do no better than one another."""
    told = [
        (value, -m.set_number) for m in means if m.figures and (value := goal.value(m.figures)) is not None
    ]
    alike = len(told) > 1 and max(told)[0] == min(told)[0]
    return -max(told)[1] if told and not alike else 0


def figure_words(figures: Figures, name: str, scale: float) -> str:
    """A figure for people; a count with what it is out of."""
    value = figures[name]
    if value is None:
        return "-"
    if name in ("TA", "TR"):
        return f"{value}/{figures[f'{name}_of']}"
    return str(value) if isinstance(value, int) and scale == 1.0 else f"{scale * value:.2f}"
