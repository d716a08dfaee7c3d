"""The search for parameters on the page: start, stop, use and save what it found."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from fastapi import APIRouter, Request
from msgspec import Meta
from starlette.responses import Response

from app.dashboard import Dashboard
from app.hands import NAME
from app.replies import body_of, json_reply
from app.robot.address import is_live
from app.routes.access import Dash
from app.routes.parameter_sets import SET_NAME
from app.tuning.goal import GOALS, goal_of
from app.tuning.plan import Plan, PlannedRun, TruthColumns
from app.tuning.space import SENSIBLE, axes_of, check
from pipeline.errors import StemmapError

router = APIRouter(prefix="/api/search")

_MOST_TRIALS = 5000
_LONGEST_MINUTES = 24 * 60.0


class _Start(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A search: `over` as after `stemmap tune --over`."""

    over: Annotated[list[Annotated[str, Meta(max_length=200)]], Meta(min_length=1, max_length=30)]
    goal: Literal["f1", "ta", "position", "pairs"] = "f1"
    false_max: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.1
    trials: Annotated[int, Meta(ge=1, le=_MOST_TRIALS)] = 200
    minutes: Annotated[float, Meta(gt=0.0, le=_LONGEST_MINUTES)] = 10.0


class _Save(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: Annotated[str, Meta(pattern=SET_NAME)]
    who: Annotated[str, Meta(pattern=NAME)] = "somebody"


@router.get("")
async def read(dashboard: Dash) -> Response:
    """How the search goes, and what can be searched for."""
    choices = {"sensible": SENSIBLE, "goals": [{"name": n, "words": words} for n, words in GOALS.items()]}
    return json_reply({**dashboard.search.as_plain(), **choices})


@router.post("")
async def start(request: Request, dashboard: Dash) -> Response:
    """Search over the run that is open, from its first scan to its last."""
    wanted: _Start = await body_of(request, _Start)
    await dashboard.search.start(_plan(dashboard, wanted))
    return json_reply(dashboard.search.as_plain(), 202)


@router.post("/stop")
async def stop(dashboard: Dash) -> Response:
    """End the search; what it found stays."""
    await dashboard.search.stop()
    return json_reply(dashboard.search.as_plain(), 202)


@router.post("/use")
async def use(dashboard: Dash) -> Response:
    """Take the values of the best set, as one step that can be undone."""
    preset_name, values, _ = dashboard.search.found()
    await dashboard.tune(lambda state: state.use(preset_name, values))
    return json_reply({})


@router.post("/save")
async def save(request: Request, dashboard: Dash) -> Response:
    """Keep the best set under a name, with where it comes from."""
    wanted: _Save = await body_of(request, _Save)
    preset_name, values, text = dashboard.search.found()
    await dashboard.sets.save(wanted.name, preset_name, values, wanted.who, text)
    return json_reply(dashboard.sets.as_plain(), 201)


def _plan(dashboard: Dashboard, wanted: _Start) -> Plan:
    source, truth, state = dashboard.source, dashboard.truth, dashboard.parameters
    if not dashboard.digest:
        raise StemmapError("no run is open", remedy="Open one")
    if is_live(source.uri):
        raise StemmapError(
            "a live run cannot be mapped again and again", where=source.uri, remedy="Open its recording"
        )
    if truth is None or "tree" not in truth.kind:
        raise StemmapError("no true trees are known of this run", remedy="Annotate some in the tab Annotate")
    axes, goal = axes_of(wanted.over), goal_of(wanted.goal, wanted.false_max)
    check(axes, state.parameters)
    return Plan(
        runs=(PlannedRun(source.uri, TruthColumns.of(truth), "annotations"),),
        axes=axes,
        start=state.parameters.model_dump(),
        storage="",
        preset=state.preset,
        goal=goal.name,
        false_max=goal.false_max,
        seed=source.seed,
        odometry=source.odometry,
        trials=wanted.trials,
        seconds=60.0 * wanted.minutes,
    )
