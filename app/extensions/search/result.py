"""Result of a search: as a parameter file with its provenance, as text for a terminal, and as JSON for the
page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import msgspec
import tomli_w

from app.common.text import count, version
from app.dashboard.parameters import file_of
from app.extensions.search.plan import Goal, Plan, Trial, pool
from pipeline.config import Parameters
from pipeline.config.model import value_text
from pipeline.errors import StemmapError
from pipeline.evaluation import MapScores

if TYPE_CHECKING:
    from app.extensions.search.search import Search


_POINTS_LIMIT = 400  # of the page's chart


class Result(msgspec.Struct, frozen=True):
    """The result of a search.

    Attributes:
        start, best: The start of the search, and the best trial; the start where no trial was better.
        better: Whether a trial was better than the start.
        made, refused: Number of trials, and of those whose values contradict one another.
        importance: See `app.extensions.search.search.Search.importances`.
        sources: URI, source hash and whether it was held out, by run.
    """

    start: Trial
    best: Trial
    better: bool
    made: int
    refused: int
    importance: dict[str, float]
    sources: tuple[tuple[str, str, bool], ...]


class SearchMessage(msgspec.Struct, frozen=True, omit_defaults=True):
    """Progress of a search in another process. A message without any field means that the search was stopped
    before it had a score.

    Attributes:
        start: Scores of the parameters with which the search begins.
        trials: Trials since the last message.
        result: The result; the last message.
    """

    start: Trial | None = None
    trials: tuple[Trial, ...] = ()
    result: Result | None = None


def result_of(search: Search) -> Result:
    """Return the result of the trials so far; the best is the start if no trial is better. It is called after
    the last trial, see `Search.importances`.

    Raises:
        StemmapError: The search was stopped before its start was scored.
    """
    if search.start is None:
        raise StemmapError("the search was stopped before its first score")
    trials, best = search.trials(), search.best()
    better = best is not None and best.loss is not None and best.loss < (search.start.loss or 0.0)
    return Result(
        search.start,
        best if better and best is not None else search.start,
        better,
        len(trials),
        sum(trial.loss is None for trial in trials),
        search.importances(),
        tuple(search.sources),
    )


def toml_of(plan: Plan, result: Result, date: str) -> str:
    """Return the best set as the text of a file for `--config`. Comments at its top contain the provenance as
    TOML. If no set is better, the text has the parameters of the start.

    Args:
        plan: The search.
        result: Result of the search.
        date: Date of the search, as it is written.
    """
    parameters = best_parameters(plan, result)
    head, _, rest = file_of(plan.preset, parameters).partition("\n")
    # Not splitlines: a name may contain U+2028, which does not end a line of TOML.
    remarks = tomli_w.dumps(provenance(plan, result, date)).strip().split("\n")
    return "\n".join([head, *(f"# {line}".rstrip() for line in remarks), rest])


def best_parameters(plan: Plan, result: Result) -> Parameters:
    """Return all parameters of the best set; those of the start if no set was better."""
    return plan.parameters.replace(dict(result.best.values) if result.better else {})


def provenance(plan: Plan, result: Result, date: str) -> dict[str, Any]:
    """Return the provenance of the best set as a dict for TOML; unknown values are omitted.

    `tuned` is a dict with `stemmap` (version), `date`, `goal` (and `false_max` for "ta"), the numbers
    `trials` and `refused`, `seed`, `odometry`, `better_than_start`, `over`, a list of the axes as text, and
    `importance`, a dict from parameter names to shares. `run` is a list of a dict for each run with `uri`,
    `sha256`, `held_out`, `truth` (name of a file, only if known) and the scores `start` and `best` of this
    run, see `_file_scores`.

    Args:
        plan: The search.
        result: Result of the search.
        date: Date of the search, as it is written.
    """
    return {
        "tuned": {
            "stemmap": version(),
            "date": date,
            "goal": plan.goal,
            **({"false_max": plan.false_max} if plan.goal == "ta" else {}),
            "trials": result.made,
            "refused": result.refused,
            "seed": plan.seed,
            "odometry": plan.odometry,
            "better_than_start": result.better,
            "over": [axis.words for axis in plan.axes],
            "importance": {name: round(value, 4) for name, value in result.importance.items()},
        },
        "run": [
            {
                "uri": uri,
                "sha256": digest,
                "held_out": held_out,
                **({"truth": planned.truth_name} if planned.truth_name else {}),
                "start": _file_scores([start]),
                "best": _file_scores([best]),
            }
            for (uri, digest, held_out), planned, start, best in zip(
                result.sources,
                plan.runs,
                _by_run(result.start, result.sources),
                _by_run(result.best, result.sources),
                strict=True,
            )
        ],
    }


def lines_of(plan: Plan, result: Result) -> list[str]:
    """Return the result as text for a terminal: goal and number of trials, scores before and after for the
    search runs and the held-out runs, and each searched parameter with its change and importance. Without a
    better set, one line states that the start was written."""
    goal = plan.aim
    refused = f", {result.refused} of them with contradicting values" if result.refused else ""
    lines = [f"{goal.words}: {count(result.made, 'trial')} over {len(plan.axes)} parameters{refused}"]
    for held_out, name in ((False, "search runs"), (True, "held out")):
        runs = [uri for uri, _, held in result.sources if held is held_out]
        if runs:
            before, after = _scores(result.start, held_out), _scores(result.best, held_out)
            lines += [f"{name} ({count(len(runs), 'run')}): {_change(before, after)}"]
    if not result.better:
        lines.append("no set was better than the start, which was written")
        return lines
    flat = plan.parameters.flat()
    for name, value in result.best.values.items():
        share = result.importance.get(name)
        suffix = "" if share is None else f"   importance {100.0 * share:.0f} %"
        lines.append(f"  {name}: {value_text(flat[name])} -> {value_text(value)}{suffix}")
    return lines


def warning_of(result: Result) -> str:
    """Return a warning if F1 of the best set is smaller on held-out runs than that of the start; empty
    otherwise, also without held-out scores or a better set."""
    if not result.better or not result.best.held_out:
        return ""
    before, after = pool(result.start.held_out).f1, pool(result.best.held_out).f1
    if after >= before:
        return ""
    return (
        f"on held-out runs F1 fell from {before:.3f} to {after:.3f}: the set fits only the runs that "
        "guided the search. Search with more runs or over fewer parameters"
    )


def _change(before: Sequence[MapScores], after: Sequence[MapScores]) -> str:
    """Return the pooled scores before and after as text, "-" for unknown ones."""
    a, b = _file_scores(before), _file_scores(after)
    return ", ".join(
        f"{_LABELS[name]} {_decimal(a.get(name))} -> {_decimal(b.get(name))}" for name in _LABELS
    )


_LABELS = {
    "f1": "F1",
    "ta": "TA",
    "false_share": "false trees",
    "position_rmse_m": "RMSE [m]",
    "mean_pair_error_percent": "pair error [%]",
}


def _file_scores(scores: Sequence[MapScores]) -> dict[str, float]:
    """Return the pooled scores for a file as a dict, rounded to 6 decimals: `f1`, `ta`, `false_share`,
    `position_rmse_m` and `mean_pair_error_percent`. Unknown ones are omitted, because TOML has no null."""
    values = asdict(pool(scores)).items()
    return {name: round(value, 6) for name, value in values if value is not None}


def _scores(trial: Trial, held_out: bool) -> tuple[MapScores, ...]:
    """Return the scores of a trial for the held-out runs or for the search runs; () for a trial whose
    held-out runs were not scored."""
    return trial.held_out if held_out else trial.training


def _by_run(trial: Trial, sources: Sequence[tuple[str, str, bool]]) -> list[MapScores]:
    """Return the scores of a trial in the order of the runs. The trial must have held-out scores if a run is
    held out.

    Args:
        trial: The trial.
        sources: URI, digest and whether it is held out, for each run.
    """
    training, held_out = iter(trial.training), iter(trial.held_out)
    return [next(held_out if held else training) for _, _, held in sources]


def _decimal(value: float | None) -> str:
    """Return a number with three decimals; "-" for None."""
    return "-" if value is None else f"{value:.3f}"


# --- for the page ------------------------------------------------------------------


def best_of(trials: Sequence[Trial], start: Trial | None) -> Trial | None:
    """Return the trial with the smallest loss, the one with the smallest number among equals; None if there
    is no scored trial.

    Args:
        trials: Trials of the search.
        start: Scored start of the search, which is included; None excludes it.
    """
    made = [t for t in (*trials, *([start] if start else [])) if t.loss is not None]
    return min(made, key=lambda t: (t.loss, t.number), default=None)


def for_page(
    plan: Plan, trials: Sequence[Trial], start: Trial | None, result: Result | None
) -> dict[str, Any]:
    """Return the progress of a search as a dict for the dashboard. The keys are:

    - `goal`, `label` and `unit`: texts of the goal; `over`: list of the axes as text;
    - `wanted` and `made`: numbers of trials;
    - `start` and `best`: see `_trial_figures`; `scores`: see `_rows`;
    - `points` and `held_out`: lists of (number of the trial, score), see below and `_held_points`;
    - `warning`, `importance`, `better` and `changes` (see `_changes`) of the result; empty or False before.

    The score of a point is None for contradicting values. Trials outside the bound of the goal are omitted,
    and of more than 400 points only every n-th is returned.

    Args:
        plan: The search.
        trials: The trials so far.
        start: The start of the search, once it is scored; None before.
        result: The result, once the search has ended; None before.
    """
    goal, best = plan.aim, best_of(trials, start)
    points = [
        (t.number, None if t.loss is None else goal.figure(t.loss))
        for t in trials
        if goal.is_kept(t.loss or 0.0)
    ]
    every = -(-len(points) // _POINTS_LIMIT) or 1
    return {
        "goal": goal.words,
        "label": goal.declaration.label,
        "unit": goal.declaration.unit,
        "over": [axis.words for axis in plan.axes],
        "wanted": plan.trials,
        "made": len(trials),
        "start": _trial_figures(plan, start),
        "best": _trial_figures(plan, best),
        "points": points[::every],
        "held_out": _held_points(goal, trials),
        "scores": _rows(plan, start, best),
        "warning": warning_of(result) if result else "",
        "importance": result.importance if result else {},
        "better": bool(result and result.better),
        "changes": _changes(plan, result) if result else [],
    }


def _trial_figures(plan: Plan, trial: Trial | None) -> dict[str, Any] | None:
    """Return a dict with `number` of a trial, `shown`, its loss as text, and the pooled scores of the search
    runs (see `_figures`); None for None."""
    if trial is None:
        return None
    return {"number": trial.number, "shown": plan.aim.shown(trial.loss or 0.0), **_figures(trial.training)}


def _figures(scores: Sequence[MapScores]) -> dict[str, Any]:
    """Return pooled scores as a dict with `f1`, `TA`, `false_share`, `rmse_cm` and `pair_error_percent`;
    unknown errors are None."""
    pooled = pool(scores)
    return {
        "f1": pooled.f1,
        "TA": pooled.ta,
        "false_share": pooled.false_share,
        "rmse_cm": None if pooled.position_rmse_m is None else 100.0 * pooled.position_rmse_m,
        "pair_error_percent": pooled.mean_pair_error_percent,
    }


def _rows(plan: Plan, start: Trial | None, best: Trial | None) -> list[dict[str, Any]]:
    """Return the scores of the start and the best parameter set: one row for the search runs, and one for the
    held-out runs if there are any; [] before both trials are scored.

    A row is a dict with `held_out` (bool), `runs`, the number of runs, and `start` and `best`, see
    `_figures`.

    Args:
        plan: The search.
        start, best: Trial of the start and of the best set; None before they are scored.
    """
    if start is None or best is None:
        return []
    counts = {held_out: sum(run.held_out is held_out for run in plan.runs) for held_out in (False, True)}
    return [
        {
            "held_out": held_out,
            "runs": runs,
            "start": _figures(_scores(start, held_out)),
            "best": _figures(_scores(best, held_out)),
        }
        for held_out, runs in counts.items()
        if runs
    ]


def _held_points(goal: Goal, trials: Sequence[Trial]) -> list[tuple[int, float | None]]:
    """Return number and held-out score of each trial that was better than all earlier ones with a held-out
    score. Trials without one, or that the goal does not accept, are skipped; the score is None if it is
    unknown."""
    held, best = [], float("inf")
    for trial in trials:
        if trial.held_out and trial.loss is not None and trial.loss < best and goal.is_kept(trial.loss):
            best = trial.loss
            held.append((trial.number, goal.figure_of(pool(trial.held_out))))
    return held


def _changes(plan: Plan, result: Result) -> list[list[Any]]:
    """Return [name, value at the start, best value] of each searched parameter, also of unchanged ones."""
    before = plan.parameters.flat()
    return [[name, before[name], value] for name, value in result.best.values.items()]
