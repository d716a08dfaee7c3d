"""The request of a browser for a search, and its plan: the open run, and runs of the list that guide the
search too or are held out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from app.common.text import count
from app.robot.address import is_live
from app.sources.request import SourceRequest, request_of_kept
from app.store.store import AnnotatedSource
from app.tuning.goal import goal_of
from app.tuning.plan import Plan, PlannedRun, TruthTable
from app.tuning.search_space import axes_of, check
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.types.records import TruthTrees

_MOST_TRIALS = 5000
_LONGEST_MINUTES = 24 * 60.0
MOST_OTHERS = 7  # each keeps up to 0.5 GB of points in memory

_Record = Annotated[int, Meta(ge=0, le=2**31 - 1)]
_Records = Annotated[list[_Record], Meta(max_length=MOST_OTHERS)]


class SearchRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Request for a search.

    Attributes:
        over: Parameters with their bounds, as `stemmap tune --over` takes them.
        goal, false_max: See `app.tuning.goal.Goal`.
        trials, minutes: Limits of the search.
        also: Record numbers of further runs that guide the search.
        held_out: Record numbers of runs that are only scored.
    """

    over: Annotated[list[Annotated[str, Meta(max_length=200)]], Meta(min_length=1, max_length=30)]
    goal: Literal["f1", "ta", "position", "pairs"] = "f1"
    false_max: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.1
    trials: Annotated[int, Meta(ge=1, le=_MOST_TRIALS)] = 200
    minutes: Annotated[float, Meta(gt=0.0, le=_LONGEST_MINUTES)] = 10.0
    also: _Records = []
    held_out: _Records = []


class OtherRun(msgspec.Struct, frozen=True):
    """A run of the list that is not open.

    Attributes:
        records: Numbers of its records, the newest first.
        name: Its name in the list.
        digest: Digest of its source.
        opened: How it was opened last.
        annotations: Its annotations.
        why_not: Why it cannot be scored; empty where it can.
    """

    records: list[int]
    name: str
    digest: str
    opened: SourceRequest
    annotations: TruthTable
    why_not: str

    def as_plain(self) -> dict[str, Any]:
        """For the browsers."""
        truth = count(len(self.annotations.x), "annotation") if self.annotations.x else "its own true trees"
        return {"record": self.records[0], "name": self.name, "truth": truth, "why_not": self.why_not}


def other_runs(
    rows: Sequence[dict[str, Any]],
    annotated: Sequence[AnnotatedSource],
    open_digest: str,
    may_be_opened: Callable[[str], str | None],
) -> list[OtherRun]:
    """Return the runs of the list except the open one, one per source. Checks whether their files exist.

    Args:
        rows: Records, the newest first.
        annotated: Sources with annotations.
        open_digest: Digest of the open run.
        may_be_opened: Returns what is opened for a URI, or None where that is not allowed.
    """
    contents = {each.source: each.annotations for each in annotated}
    found: dict[str, OtherRun] = {}
    scored: set[str] = set()
    for row in rows:
        digest = row["source"]
        if digest == open_digest:
            continue
        if row["scores"] is not None:
            scored.add(digest)
        if digest in found:
            found[digest].records.append(row["id"])
            continue
        uri = may_be_opened(row["uri"])
        opened = request_of_kept(
            uri or row["uri"], odometry=row["odometry"], seed=row["seed"], choices=row["chosen"]
        )
        known = contents.get(digest, ())
        table = TruthTable(
            [c.x for c in known], [c.y for c in known], [c.dbh for c in known], [c.kind for c in known]
        )
        why = "from another machine it cannot be opened" if uri is None else _why_gone(uri)
        found[digest] = OtherRun([row["id"]], row["name"], digest, opened, table, why)
    return [
        msgspec.structs.replace(run, why_not=run.why_not or _why_no_truth(run, digest in scored))
        for digest, run in found.items()
    ]


def plan_of(
    asked: SearchRequest,
    source: SourceRequest,
    digest: str,
    truth: TruthTrees | None,
    parameters: Parameters,
    preset: str,
    others: Sequence[OtherRun],
) -> Plan:
    """Return the plan of a search.

    Args:
        asked: The request.
        source, digest, truth: The open run; the digest is empty where none is open.
        parameters, preset: Those in force.
        others: The other runs of the list.

    Raises:
        StemmapError: The request cannot be searched.
    """
    if not digest:
        raise StemmapError("no run is open", remedy="Open one")
    if is_live(source.uri):
        raise StemmapError("a live run cannot be mapped again", where=source.uri, remedy="Open its recording")
    if truth is None or "tree" not in truth.kind:
        raise StemmapError("no true trees are known of this run", remedy="Annotate some in the tab Annotate")
    axes, goal = axes_of(asked.over), goal_of(asked.goal, asked.false_max)
    check(axes, parameters)
    shown = PlannedRun(source.request(), TruthTable.of(truth), "annotations")
    return Plan(
        runs=(shown, *_planned(asked, others)),
        axes=axes,
        start=parameters.model_dump(),
        storage="",
        preset=preset,
        goal=goal.name,
        false_max=goal.false_max,
        seed=source.seed,
        odometry=source.odometry,
        trials=asked.trials,
        seconds=60.0 * asked.minutes,
    )


def check_same(stopped: Plan, now: Plan) -> None:
    """Check that a stopped search can continue under the same conditions.

    Raises:
        StemmapError: Something has changed since it began.
    """
    before, after = stopped.parameters.flat(), now.parameters.flat()
    changed = [name for name in before if before[name] != after[name]]
    if changed:
        most = ", ".join(changed[:3]) + (f" and {len(changed) - 3} more" if len(changed) > 3 else "")
        raise StemmapError(
            "parameters were changed since the search began", where=most, remedy="Undo that, or search again"
        )
    for old, new in zip(stopped.runs, now.runs, strict=True):
        if (old.truth, old.annotations) != (new.truth, new.annotations):
            remedy = "Undo that, or search again"
            raise StemmapError(
                "true trees were edited since the search began", where=new.source.uri, remedy=remedy
            )
    if msgspec.structs.replace(stopped, storage="", preset=now.preset) != now:
        raise StemmapError(
            "the runs were opened in another way since the search began", remedy="Search again"
        )


def _planned(asked: SearchRequest, others: Sequence[OtherRun]) -> list[PlannedRun]:
    by_record = {record: run for run in others for record in run.records}
    planned: list[PlannedRun] = []
    named: set[str] = set()
    for record, held_out in [(r, False) for r in asked.also] + [(r, True) for r in asked.held_out]:
        run = by_record.get(record)
        if run is None:
            raise StemmapError(
                "there is no such run in the list", where=f"run {record}", remedy="Reload the list"
            )
        if run.why_not:
            raise StemmapError(run.why_not, where=run.name, remedy="Leave it out")
        if run.digest in named:
            raise StemmapError("a run is named twice", where=run.name, remedy="Name it once")
        named.add(run.digest)
        name = "annotations" if run.annotations.x else ""
        digest = "" if run.digest == run.opened.uri else run.digest  # a source without digest has its URI
        planned.append(PlannedRun(run.opened, None, name, held_out, run.annotations, digest))
    if len(planned) > MOST_OTHERS:
        raise StemmapError(
            f"{count(len(planned), 'other run')} are too many",
            remedy=f"Name {MOST_OTHERS} at most, or use `stemmap tune`",
        )
    return planned


def _why_gone(uri: str) -> str:
    if is_live(uri):
        return "it is a live run, which cannot be mapped again"
    if uri.startswith("sim:"):
        return ""
    try:
        there = Path(uri.removeprefix("file://")).expanduser().exists()
    except (OSError, ValueError, RuntimeError):  # RuntimeError: unknown home directory
        there = False
    return "" if there else "its recording does not exist any more"


def _why_no_truth(run: OtherRun, scored: bool) -> str:
    return "" if scored or "tree" in run.annotations.kind else "no true trees are known of it"
