"""What came of a search: the best set as a file, with where it comes from, and as lines for people."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import msgspec
import tomli_w

from app.common.text import count
from app.common.version import version
from app.dashboard.parameters import file_of
from app.tuning.goal import RunScore, pool
from app.tuning.plan import Plan
from app.tuning.trial import Trial
from pipeline.config import Parameters
from pipeline.config.model import Value

if TYPE_CHECKING:
    from app.tuning.search import Search


class Result(msgspec.Struct, frozen=True):
    """What came of a search.

    Attributes:
        start, best: Scores of the parameters to begin with, and of the best set that was tried; the start
            where none was better.
        better: Whether a set was better than the start.
        made, refused: Trials, and how many of them cannot be mapped with.
        importance: See `importances`.
        sources: URI, source hash and whether it was held out, by run.
    """

    start: Trial
    best: Trial
    better: bool
    made: int
    refused: int
    importance: dict[str, float]
    sources: tuple[tuple[str, str, bool], ...]


def result_of(search: Search) -> Result:
    """What came of the trials that were made so far.

    Raises:
        StoppedError: It was asked to stop while a held-out run was scored.
    """
    from app.tuning.search import importances

    trials, best = search.trials(), search.best()
    better = best is not None and best.loss is not None and best.loss < (search.start.loss or 0.0)
    return Result(
        search.start,
        search.with_held_out(best) if better and best is not None else search.start,
        better,
        len(trials),
        sum(trial.loss is None for trial in trials),
        importances(search.study),
        tuple(search.sources),
    )


def toml_of(plan: Plan, result: Result, date: str) -> str:
    """The best set as a file that `--config` takes; where it comes from stands in it as remarks, which are
    TOML themselves (see `provenance_in`)."""
    parameters = best_parameters(plan, result)
    head, _, rest = file_of(plan.preset, parameters).partition("\n")
    # Not by splitlines: a name may hold U+2028 or the like, which ends no line of TOML.
    remarks = tomli_w.dumps(provenance(plan, result, date)).strip().split("\n")
    return "\n".join([head, *(f"# {line}".rstrip() for line in remarks), rest])


def best_parameters(plan: Plan, result: Result) -> Parameters:
    """All values of the best set."""
    return plan.parameters.replace(dict(result.best.values) if result.better else {})


def provenance(plan: Plan, result: Result, date: str) -> dict[str, Any]:
    """Where a set comes from, as plain values."""
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
                "start": _figures([start]),
                "best": _figures([best]),
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


def provenance_in(text: str) -> dict[str, Any]:
    """Where the set of a file comes from; empty where it does not say so."""
    lines = text.split("\n")[1:]
    remarks = []
    for line in lines:
        if not line.startswith("#"):
            break
        remarks.append(line.removeprefix("#").removeprefix(" "))
    try:
        return tomllib.loads("\n".join(remarks))
    except tomllib.TOMLDecodeError:
        return {}


def lines_of(plan: Plan, result: Result) -> list[str]:
    """What came of it, for people."""
    goal = plan.aim
    refused = f", {result.refused} of them contradicted themselves" if result.refused else ""
    lines = [f"{goal.words}: {count(result.made, 'trial')} over {len(plan.axes)} parameters{refused}"]
    for held_out, name in ((False, "searched over"), (True, "held out")):
        runs = [uri for uri, _, held in result.sources if held is held_out]
        if runs:
            before, after = _scores(result.start, held_out), _scores(result.best, held_out)
            lines += [f"{name} ({count(len(runs), 'run')}): {_change(before, after)}"]
    if not result.better:
        lines.append("no set was better than the one it began with, which is what was written")
        return lines
    flat = plan.parameters.flat()
    for name, value in result.best.values.items():
        share = result.importance.get(name)
        told = "" if share is None else f"   importance {100.0 * share:.0f} %"
        lines.append(f"  {name}: {_word(flat[name])} -> {_word(value)}{told}")
    return lines


def warning_of(result: Result) -> str:
    """What a person should know of a set that does worse where it was not tuned; empty for nothing."""
    if not result.better or not result.best.held_out:
        return ""
    before, after = pool(result.start.held_out).f1, pool(result.best.held_out).f1
    if after >= before:
        return ""
    return (
        f"on held-out runs F1 fell from {before:.3f} to {after:.3f}: the set is tuned to the runs that it "
        "was searched over. Search over more runs, or over fewer parameters"
    )


def _change(before: Sequence[RunScore], after: Sequence[RunScore]) -> str:
    a, b = _figures(before), _figures(after)
    return ", ".join(f"{_LABELS[name]} {_shown(a.get(name))} -> {_shown(b.get(name))}" for name in _LABELS)


_LABELS = {
    "f1": "F1",
    "ta": "TA",
    "false_share": "false trees",
    "position_rmse_m": "RMSE [m]",
    "mean_pair_error_percent": "pair error [%]",
}


def _figures(scores: Sequence[RunScore]) -> dict[str, float]:
    """What is known of several runs as one; TOML has no null."""
    pooled = pool(scores)
    values = {
        "f1": pooled.f1,
        "ta": pooled.ta,
        "false_share": pooled.false_share,
        "position_rmse_m": pooled.position_rmse,
        "mean_pair_error_percent": pooled.pair_error,
    }
    return {name: round(value, 6) for name, value in values.items() if value is not None}


def _scores(trial: Trial, held_out: bool) -> tuple[RunScore, ...]:
    return trial.held_out if held_out else trial.training


def _by_run(trial: Trial, sources: Sequence[tuple[str, str, bool]]) -> list[RunScore]:
    training, held_out = iter(trial.training), iter(trial.held_out)
    return [next(held_out if held else training) for _, _, held in sources]


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _word(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else json.dumps(value).strip('"')
