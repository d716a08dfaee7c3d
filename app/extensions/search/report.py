"""Comparison of parameter sets: its plan, the order of its jobs, and its rows, means and best sets, as text,
as tables and as a web page.

Times are in a file of their own, so that the tables and the JSON have the same bytes for the same runs and
parameters, wherever they were computed.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from app.common.text import count, version
from app.extensions.search.grid import PRESET, words_of
from app.extensions.search.jobs import Job, JobResult, ScoringProcesses
from app.extensions.search.scoring import PreparedRun
from pipeline.config import Parameters
from pipeline.config.model import Value, validated, value_text
from pipeline.errors import ParameterError
from pipeline.evaluation import MapScores
from pipeline.io.atomic_files import write_texts
from pipeline.io.result_files import csv_text
from pipeline.remapping.rerun import segmentation_key


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """All jobs of a comparison.

    Attributes:
        runs: The runs, in the order in which they were named.
        sets: The combinations of parameter values.
        jobs: Dict from (number of the set, number of the run), from 0, to the job.
        left_out: Dict from the same numbers to the reason, for sets whose values contradict one another for a
            run.
    """

    runs: tuple[PreparedRun, ...]
    sets: tuple[dict[str, Value], ...]
    jobs: dict[tuple[int, int], Job]
    left_out: dict[tuple[int, int], str]


def plan_jobs(
    runs: Sequence[PreparedRun],
    sets: Sequence[dict[str, Value]],
    base: Callable[[PreparedRun, dict[str, Value]], Parameters],
) -> SweepPlan:
    """Return the jobs of all sets and runs, by set and then by run. Combinations that contradict themselves
    are left out, with the reason.

    Args:
        runs, sets: What is combined.
        base: Returns the parameters that a combination changes, for a run; may raise ParameterError.

    Raises:
        ParameterError: Every set contradicts itself for every run.
    """
    jobs: dict[tuple[int, int], Job] = {}
    left_out: dict[tuple[int, int], str] = {}
    for s, changes in enumerate(sets):
        values = {name: value for name, value in changes.items() if name != PRESET}
        for r, run in enumerate(runs):
            try:
                jobs[s, r] = Job(run.run, base(run, changes).replace(values).model_dump())
            except ParameterError as error:
                left_out[s, r] = error.what
    if not jobs:
        (s, _), why = next(iter(left_out.items()))
        raise ParameterError(f"none of {count(len(sets), 'set')} can be used: {why}", where=words_of(sets[s]))
    return SweepPlan(tuple(runs), tuple(sets), jobs, left_out)


def sweep(
    jobs: Sequence[Job],
    processes: ScoringProcesses[int],
    progress: Callable[[int], object] = lambda _jobs: None,
) -> list[JobResult]:
    """Compute all jobs, or read their stored results; return the results in the order of the jobs. A job that
    fails has an error in its result.

    Args:
        jobs: The jobs.
        processes: Compute the jobs; the caller closes them.
        progress: Called with 1 for each job that was completed.

    Raises:
        StemmapError: No process can be started.
    """
    answers: dict[int, JobResult] = {}
    waiting: dict[bytes, deque[int]] = {}  # by group: jobs that share the results of the front end
    for number, job in enumerate(jobs):
        waiting.setdefault(_group(job), deque()).append(number)
    group_of: dict[int, bytes] = {}  # the last group of each process

    def next_job(worker: int) -> tuple[int, Job] | None:
        """Return a job of the last group of a process, else of one that no other process has, else of the
        largest group."""
        if group_of.get(worker) not in waiting:
            others = set(group_of.values())
            group_of[worker] = max(waiting, key=lambda g: (g not in others, len(waiting[g])), default=b"")
        group = group_of[worker]
        if group not in waiting:
            return None
        number = waiting[group].popleft()
        if not waiting[group]:
            del waiting[group]
        return number, jobs[number]

    while len(answers) < len(jobs):
        for number, answer in processes.advance(next_job):
            answers[number] = answer
            progress(1)
    return [answers[number] for number in range(len(jobs))]


def _group(job: Job) -> bytes:
    """Return a key that is equal for jobs that share the results of the front end."""
    return msgspec.json.encode(job.run) + segmentation_key(validated(job.parameters))


Figures = dict[str, float | int | None]
Criterion = Callable[[Figures], tuple[float, ...] | None]

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
        figures: Dict from the names of COLUMNS to scores; empty for a failure.
        seconds: Computing time [s]; 0 for a failure, and for a mean the sum.
        looked: Whether the front end (segmentation of scans) ran in this time.
        error: Reason of the failure.
    """

    set_number: int
    run: int
    figures: Figures
    seconds: float = 0.0
    looked: bool = False
    error: str = ""


@dataclass(frozen=True, slots=True)
class Comparison:
    """All rows.

    Attributes:
        rows: By set and run.
        means: A row per set.
        best: Dict from each name in CRITERIA to the number of the best set, from 1; 0 if there is none, see
            `best_of`.
    """

    plan: SweepPlan
    rows: tuple[Row, ...]
    means: tuple[Row, ...]
    best: dict[str, int]

    @property
    def failed(self) -> list[Row]:
        """Rows of single runs with an error."""
        return [row for row in self.rows if row.error]


def _most(name: str) -> Criterion:
    """Return a criterion that prefers a large value of the score `name`. It returns (value,) for the scores
    of a row, and None if the score is unknown."""
    return lambda f: None if f[name] is None else (float(f[name] or 0.0),)


def _least(name: str) -> Criterion:
    """Return a criterion that prefers a small value of the score `name`, then a large F1. It returns (-value,
    F1) for the scores of a row, and None if the score is unknown."""
    return lambda f: None if f[name] is None else (-float(f[name] or 0.0), float(f["f1"] or 0.0))


def _careful(f: Figures) -> tuple[float, ...] | None:
    """Return (-(FA + spurious), TA), so that few false trees are preferred, then many true ones; never
    None."""
    wrong = float(f["FA"] or 0) + float(f["spurious"] or 0)
    return (-wrong, float(f["TA"] or 0))


#: Criteria for the best set by name: the value of a row's figures, larger is better, None for an unknown one.
CRITERIA: dict[str, Criterion] = {
    "F1": _most("f1"),
    "completeness": _most("completeness"),
    "fewest false trees, then most true ones": _careful,
    "position RMSE": _least("position_rmse_m"),
    "pair error": _least("mean_pair_error_percent"),
}


def compare_results(plan: SweepPlan, answers: dict[tuple[int, int], JobResult]) -> Comparison:
    """Return the rows, the means and the best sets of a comparison.

    Args:
        plan: The comparison.
        answers: Dict from (number of the set, number of the run), from 0, to the result; one for each job of
            the plan.
    """
    rows, means = [], []
    for s in range(len(plan.sets)):
        of_set = [_row(plan, answers, s, r) for r in range(len(plan.runs))]
        rows += of_set
        means.append(_mean(s + 1, of_set))
    return Comparison(
        plan, tuple(rows), tuple(means), {words: best_of(means, value) for words, value in CRITERIA.items()}
    )


def _row(plan: SweepPlan, answers: dict[tuple[int, int], JobResult], s: int, r: int) -> Row:
    """Return the row of a set and a run. A set that was left out, failed, or has no ground truth near the
    path has no figures and an error.

    Args:
        plan: The comparison.
        answers: Dict from (number of the set, number of the run), from 0, to the result.
        s, r: Numbers of set and run, from 0 on.
    """
    if (s, r) in plan.left_out:
        return Row(s + 1, r + 1, {}, error=plan.left_out[s, r])
    answer = answers[s, r]
    if answer.scores is None or answer.problem:
        return Row(s + 1, r + 1, {}, error=answer.problem)
    return Row(s + 1, r + 1, _figures(answer, answer.scores), answer.seconds, answer.looked)


def _figures(answer: JobResult, scores: MapScores) -> Figures:
    """Return a dict from the names in COLUMNS to the scores of a job; lengths are in metres."""
    figures: Figures = {name: getattr(scores, name).count for name in ("TA", "FR", "TR", "FA")}
    figures |= {"TA_of": scores.TA.of, "TR_of": scores.TR.of, "scans": answer.scans, "trees": answer.trees}
    return {
        name: figures[name] if name in figures else getattr(scores, name.removesuffix("_m"))
        for name in COLUMNS
    }


def _mean(set_number: int, rows: Sequence[Row]) -> Row:
    """Return the row of a set over all runs. Counts are summed over the runs; all other scores are means over
    the runs that have them, with equal weights, or None if no run has one. A set that failed on a run has the
    error of the first failure and no scores.

    Args:
        set_number: Number of the set, from 1 on.
        rows: Rows of the set, one per run.
    """
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


def best_of(means: Sequence[Row], criterion: Criterion) -> int:
    """Return the number of the best set, the first of equals; 0 if no value is known, or if several are known
    and all are equal. A single set with a known value is the best.

    Args:
        means: One row per set.
        criterion: One of CRITERIA.
    """
    equals = equally_good(means, criterion)
    known = sum(bool(m.figures) and criterion(m.figures) is not None for m in means)
    return equals[0] if equals and (known == 1 or len(equals) < known) else 0


def equally_good(means: Sequence[Row], criterion: Criterion) -> list[int]:
    """Return the numbers of all sets with the best value of a criterion, in ascending order; [] if no value
    is known. Arguments as in `best_of`."""
    values = {m.set_number: value for m in means if m.figures and (value := criterion(m.figures)) is not None}
    best = max(values.values(), default=())
    return [number for number, value in values.items() if value == best]


def figure_words(figures: Figures, name: str, scale: float) -> str:
    """Return a score as text: TA and TR as "count/total", other integers with `scale` 1 as they are, and all
    other scores times `scale` with two decimals; "-" if it is unknown.

    Args:
        figures: Scores of a row; must have the name.
        name: Name of the score.
        scale: Factor from the stored value to the shown one.
    """
    value = figures[name]
    if value is None:
        return "-"
    if name in ("TA", "TR"):
        return f"{value}/{figures[f'{name}_of']}"
    return str(value) if isinstance(value, int) and scale == 1.0 else f"{scale * value:.2f}"


# --- text and tables ---------------------------------------------------------------------------------

MOST_LINES = 60
_COMPUTED = ("=", "+", "-", "@", "\t", "\r")


def lines(comparison: Comparison) -> list[str]:
    """Return the comparison as text: a table with a row per set, preceded by the rows of its runs if there
    are several runs and few rows, and the best sets.

    With more than `MOST_LINES` rows, the rows of single runs are omitted; with still more, only the
    `MOST_LINES` sets with the largest F1 are shown, sorted by F1, and a line gives the number of the others.
    """
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
        rows = sorted(rows, key=_by_f1)[:MOST_LINES]
        notes.append(f"{count(left_out, 'set')} with a smaller F1 not shown; --out DIR writes all of them")
    heads = [
        "set",
        "parameters",
        *([] if one else ["run"]),
        *(f"{h} {u}".strip() for _, h, u, _ in SHOWN),
        "s",
    ]
    cells = [_cells(comparison, row, one=one) for row in rows]
    return [*_aligned([heads, *cells]), *notes, *_best_lines(comparison)]


def _by_f1(row: Row) -> float:
    """Return the key that sorts rows by decreasing F1, those without F1 last."""
    f1 = row.figures.get("f1")
    return 1.0 if f1 is None else -f1


def files(comparison: Comparison, folder: Path) -> list[str]:
    """Write results.csv, means.csv, results.json, times.csv and report.html into a folder, and return their
    names. The folder is created; existing files are replaced.

    Raises:
        StemmapError: A file cannot be written. Each file is complete or unchanged.
        OSError: The folder cannot be created.
    """
    texts = {
        "results.csv": _table(comparison, comparison.rows),
        "means.csv": _table(comparison, comparison.means),
        "results.json": json_text(comparison),
        "times.csv": _times(comparison),
        "report.html": page(comparison),
    }
    write_texts(folder, texts)
    return list(texts)


def json_text(comparison: Comparison) -> str:
    """Return the comparison without the times as the text of a JSON object that ends with a newline. The keys
    are `stemmap` (version); `runs`, a list of objects with `run` (number from 1), `name`, `sha256`, `seed`,
    `odometry` and `true_trees` (number); `sets`, a list of objects with `set` (number from 1) and
    `parameters`; `results` and `means`, lists of `_record` for each set and run, and for each set; and
    `best`, the numbers of the best sets by criterion."""
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
                "true_trees": sum(each.kind == "tree" for each in run.run.truth),
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
    """Return a row as a dict of JSON values: `set`, `run` (not for a mean), and either the scores of COLUMNS
    or `error`."""
    numbers = {"set": row.set_number, **({"run": row.run} if row.run else {})}
    if row.error:
        return {**numbers, "error": row.error}
    return {**numbers, **{name: row.figures[name] for name in COLUMNS}}


def _table(comparison: Comparison, rows: Sequence[Row]) -> str:
    """Return rows as CSV text: set, a column per parameter, run and source (not for means), COLUMNS and
    error; unknown values are empty cells."""
    plan = comparison.plan
    axes = list(plan.sets[0]) if plan.sets else []
    of_runs = any(row.run for row in rows)
    head = ["set", *axes, *(["run", "source"] if of_runs else []), *COLUMNS, "error"]
    cells = (
        [
            row.set_number,
            *(plan.sets[row.set_number - 1][axis] for axis in axes),
            *([row.run, plan.runs[row.run - 1].name] if of_runs else []),
            *(row.figures.get(name) for name in COLUMNS),
            row.error,
        ]
        for row in rows
    )
    return csv_text(head, ([_cell(cell) for cell in row] for row in cells))


def _times(comparison: Comparison) -> str:
    """Return the computing times as CSV text with a header and a row for each set and run that did not fail:
    "set" and "run", their numbers from 1; "seconds", with 3 decimals; and "scans_looked_at", "true" if the
    front end ran, else "false"."""
    rows = [
        [str(r.set_number), str(r.run), f"{r.seconds:.3f}", str(r.looked).lower()]
        for r in comparison.rows
        if not r.error
    ]
    return csv_text(["set", "run", "seconds", "scans_looked_at"], rows)


def _cell(cell: object) -> str:
    """Return a cell as it is written: empty for None, true or false for a bool, and with an apostrophe before
    a text that a spreadsheet would compute because it begins with a character of `_COMPUTED`, such as a file
    name `=1+1.mcap`."""
    if cell is None:
        return ""
    if isinstance(cell, bool):
        return str(cell).lower()
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(_COMPUTED) else str(cell)


def _cells(comparison: Comparison, row: Row, *, one: bool) -> list[str]:
    """Return the cells of a row of the text table: set, parameters, run, scores and seconds. A row that
    failed ends with its error in place of the scores.

    Args:
        comparison: The comparison.
        row: The row.
        one: Whether the comparison has one run; then there is no cell for it.
    """
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
    """Return the table as lines with aligned columns. Rows with fewer cells than the first one (failures) do
    not count for the widths, and their cells are padded only in the columns of text."""
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
    """Return one line per criterion with the best set and its equals. For a single set a criterion without a
    known value has no line."""
    lines = []
    for goal, number in comparison.best.items():
        if number:
            others = equally_good(comparison.means, CRITERIA[goal])[1:]
            also = f", equal to {count(len(others), 'other set')}: {', '.join(map(str, others))}"
            words = words_of(comparison.plan.sets[number - 1])
            lines.append(f"best {goal}: set {number} ({words}){also if others else ''}")
        elif len(comparison.plan.sets) > 1:
            lines.append(f"best {goal}: none; all sets are equal or unknown")
    return lines


# --- web page ----------------------------------------------------------------------------------------

# Figures whose smallest value is best.
_LEAST = {"FR", "FA", "spurious", "position_rmse_m", "position_bias_m", "mean_pair_error_percent"}


def page(comparison: Comparison) -> str:
    """Return the comparison as the text of one HTML file without scripts or links."""
    from jinja2 import Environment, PackageLoader

    environment = Environment(
        loader=PackageLoader("app.extensions.search", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    plan, means = comparison.plan, comparison.means
    tables = [
        (run.name, "", [row for row in comparison.rows if row.run == r]) for r, run in enumerate(plan.runs, 1)
    ]
    if len(plan.runs) > 1:
        note = "Counts are summed; other figures are means of the runs."
        tables.insert(0, ("Means over the runs", note, list(means)))
    return environment.get_template("report.html.j2").render(
        title=f"{count(len(plan.sets), 'set')} of parameters on {count(len(plan.runs), 'run')}",
        version=version(),
        plan=plan,
        failed=count(len(comparison.failed), "result") if comparison.failed else "",
        best_sets=comparison.best,
        charts=[_chart(axis, points) for axis, points in _f1_by_value(comparison).items()],
        axes=["set", *(plan.sets[0] if plan.sets else ())],
        tables=[(heading, note, rows, _best(rows)) for heading, note, rows in tables],
        shown=SHOWN,
        words_of=words_of,
        value_words=value_text,
        figure_words=figure_words,
    )


def _best(rows: list[Row]) -> dict[str, float | None]:
    """Return a dict from each score of SHOWN to its best value in the rows: the smallest for scores in
    `_LEAST`, else the largest; None if there are fewer than two rows or the score is unknown in all of
    them."""
    best: dict[str, float | None] = {}
    for name, _, _, _ in SHOWN:
        known = [value for row in rows if not row.error and (value := row.figures[name]) is not None]
        best[name] = (min if name in _LEAST else max)(known) if len(rows) > 1 and known else None
    return best


def _f1_by_value(comparison: Comparison) -> dict[str, dict[float, list[float]]]:
    """Return a dict from parameter names to dicts from each value to the list of the mean F1 [%] of all sets
    with this value. Parameters that are not numeric or have fewer than two values with a known F1 are
    omitted."""
    plan, found = comparison.plan, {}
    for axis in plan.sets[0] if plan.sets else ():
        points: dict[float, list[float]] = {}
        for mean in comparison.means:
            value, f1 = plan.sets[mean.set_number - 1][axis], mean.figures.get("f1")
            if isinstance(value, int | float) and not isinstance(value, bool) and f1 is not None:
                points.setdefault(float(value), []).append(100.0 * f1)
        if len(points) > 1:
            found[axis] = points
    return found


def _chart(axis: str, points: dict[float, list[float]]) -> dict[str, Any]:
    """Return a chart of F1 over a parameter as a dict for the template: `axis`, the name of the parameter;
    `best` and `mean`, lists of coordinates "x,y" [px] of the lines through the best and the mean F1 at each
    value; and the labels of the ends of the axes as strings, `low`, `high` (F1 [%]) and `first`, `last`
    (value).

    Args:
        axis: Name of the parameter.
        points: Dict from each value, at least two, to the F1 [%] of its sets.
    """
    xs = sorted(points)
    best, mean = [max(points[x]) for x in xs], [sum(points[x]) / len(points[x]) for x in xs]
    low, high = min(mean), max(best)
    low, high = (low - 1.0, high + 1.0) if high - low < 1e-9 else (low, high)

    def line(ys: list[float]) -> list[str]:
        return [
            f"{50 + 280 * (x - xs[0]) / (xs[-1] - xs[0]):.1f},{125 - 100 * (y - low) / (high - low):.1f}"
            for x, y in zip(xs, ys, strict=True)
        ]

    limits = {"low": f"{low:.1f}", "high": f"{high:.1f}", "first": f"{xs[0]:g}", "last": f"{xs[-1]:g}"}
    return {"axis": axis, "best": line(best), "mean": line(mean), **limits}
