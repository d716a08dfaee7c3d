"""What the browsers are told of a search: figures, the picture's points, what changed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from app.tuning.goal import Goal, GoalName, Pooled, RunScore, pool
from app.tuning.plan import Plan
from app.tuning.result import Result, warning_of
from app.tuning.trial import Trial

_MOST_SHOWN = 400  # points of the picture


def best_of(trials: Sequence[Trial], start: Trial | None) -> Trial | None:
    """The best set so far, the start among them; the earliest of equals."""
    made = [t for t in (*trials, *([start] if start else [])) if t.loss is not None]
    return min(made, key=lambda t: (t.loss, t.number), default=None)


def told_of(
    plan: Plan, trials: Sequence[Trial], start: Trial | None, result: Result | None
) -> dict[str, Any]:
    """A search for the browsers, without its state.

    Args:
        plan: What is searched for.
        trials: Made so far; start: the scores to begin with, once they are known.
        result: What came of it, once it has ended.
    """
    goal, best = plan.aim, best_of(trials, start)
    points = [(t.number, _shown(goal.name, t.loss)) for t in trials if goal.is_kept(t.loss or 0.0)]
    every = -(-len(points) // _MOST_SHOWN) or 1
    return {
        "goal": goal.words,
        "label": goal.label,
        "unit": {"position": "cm", "pairs": "%"}.get(goal.name, ""),
        "over": [axis.words for axis in plan.axes],
        "wanted": plan.trials,
        "made": len(trials),
        "start": _told(plan, start),
        "best": _told(plan, best),
        "points": points[::every],
        "held_out": _held_points(goal, trials),
        "scores": _rows(plan, start, best),
        "warning": warning_of(result) if result else "",
        "importance": result.importance if result else {},
        "better": bool(result and result.better),
        "changes": _changes(plan, result) if result else [],
    }


def _told(plan: Plan, trial: Trial | None) -> dict[str, Any] | None:
    if trial is None:
        return None
    return {"number": trial.number, "shown": plan.aim.shown(trial.loss or 0.0), **_figures(trial.training)}


def _figures(scores: Sequence[RunScore]) -> dict[str, Any]:
    pooled = pool(scores)
    return {
        "f1": pooled.f1,
        "TA": pooled.ta,
        "false_share": pooled.false_share,
        "rmse_cm": None if pooled.position_rmse is None else 100.0 * pooled.position_rmse,
        "pair_error_percent": pooled.pair_error,
    }


def _rows(plan: Plan, start: Trial | None, best: Trial | None) -> list[dict[str, Any]]:
    """How the runs searched over and the held-out ones were mapped to begin with, and with the best set."""
    held = sum(run.held_out for run in plan.runs)
    if start is None or best is None:
        return []
    rows: list[dict[str, Any]] = [
        {
            "held_out": False,
            "runs": len(plan.runs) - held,
            "start": _figures(start.training),
            "best": _figures(best.training),
        }
    ]
    if held:
        rows.append(
            {
                "held_out": True,
                "runs": held,
                "start": _figures(start.held_out),
                "best": _figures(best.held_out),
            }
        )
    return rows


def _held_points(goal: Goal, trials: Sequence[Trial]) -> list[tuple[int, float | None]]:
    """The figure on the held-out runs of each set that was the best when it was made."""
    held, best = [], float("inf")
    for trial in trials:
        if trial.held_out and trial.loss is not None and trial.loss < best and goal.is_kept(trial.loss):
            best = trial.loss
            held.append((trial.number, _figure(goal.name, pool(trial.held_out))))
    return held


def _figure(goal: GoalName, pooled: Pooled) -> float | None:
    if goal in ("f1", "ta"):
        return pooled.f1 if goal == "f1" else pooled.ta
    if goal == "pairs":
        return pooled.pair_error
    return None if pooled.position_rmse is None else 100.0 * pooled.position_rmse


def _shown(goal: GoalName, loss: float | None) -> float | None:
    """A loss as the figure that is drawn; None of a set that cannot be mapped with."""
    if loss is None:
        return None
    return 1.0 - loss if goal in ("f1", "ta") else 100.0 * loss if goal == "position" else loss


def _changes(plan: Plan, result: Result) -> list[list[Any]]:
    """Name, value before and value found."""
    before = plan.parameters.flat()
    return [[name, before[name], value] for name, value in result.best.values.items()]
