"""What a browser asks a search for, and the plan that comes of it: the run that is open, and runs of the list
that are searched over too or held out.
"""

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
from app.tuning.plan import Plan, PlannedRun, TruthColumns
from app.tuning.space import axes_of, check
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.types.records import TruthTrees

_MOST_TRIALS = 5000
_LONGEST_MINUTES = 24 * 60.0
MOST_OTHERS = 7  # each holds the points of its scans in memory, half a gigabyte at most

_Record = Annotated[int, Meta(ge=0, le=2**31 - 1)]
_Records = Annotated[list[_Record], Meta(max_length=MOST_OTHERS)]


class SearchAsked(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A search: `over` as after `stemmap tune --over`; `also` and `held_out` are numbers of records, searched
    over beside the run that is open, or only scored."""

    over: Annotated[list[Annotated[str, Meta(max_length=200)]], Meta(min_length=1, max_length=30)]
    goal: Literal["f1", "ta", "position", "pairs"] = "f1"
    false_max: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.1
    trials: Annotated[int, Meta(ge=1, le=_MOST_TRIALS)] = 200
    minutes: Annotated[float, Meta(gt=0.0, le=_LONGEST_MINUTES)] = 10.0
    also: _Records = []
    held_out: _Records = []


class OtherRun(msgspec.Struct, frozen=True):
    """A run of the list that is not the one that is open.

    Attributes:
        records: Numbers of its records, the newest first.
        name: As the list has it.
        digest: Of its source.
        opened: How it was opened last.
        annotations: What people said of it.
        why_not: Why it cannot be judged by its true trees; empty where it can.
    """

    records: list[int]
    name: str
    digest: str
    opened: SourceRequest
    annotations: TruthColumns
    why_not: str

    def as_plain(self) -> dict[str, Any]:
        """For the browsers."""
        told = count(len(self.annotations.x), "annotation") if self.annotations.x else "its own true trees"
        return {"record": self.records[0], "name": self.name, "truth": told, "why_not": self.why_not}


def other_runs(
    rows: Sequence[dict[str, Any]],
    annotated: Sequence[AnnotatedSource],
    open_digest: str,
    may_be_opened: Callable[[str], str | None],
) -> list[OtherRun]:
    """The runs of the list, one a source, but for the one that is open. Looks at the disk.

    Args:
        rows: Records, the newest first.
        annotated: What was annotated.
        open_digest: Of the run that is open.
        may_be_opened: What is to be opened for a URI; None where it may not be.
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
        said = contents.get(digest, ())
        table = TruthColumns(
            [c.x for c in said], [c.y for c in said], [c.dbh for c in said], [c.kind for c in said]
        )
        why = "from another machine it cannot be opened" if uri is None else _why_gone(uri)
        found[digest] = OtherRun([row["id"]], row["name"], digest, opened, table, why)
    return [
        msgspec.structs.replace(run, why_not=run.why_not or _why_no_truth(run, digest in scored))
        for digest, run in found.items()
    ]


def plan_of(
    asked: SearchAsked,
    source: SourceRequest,
    digest: str,
    truth: TruthTrees | None,
    parameters: Parameters,
    preset: str,
    others: Sequence[OtherRun],
) -> Plan:
    """The plan of a search.

    Args:
        asked: What for.
        source, digest, truth: Of the run that is open; digest empty where none is.
        parameters, preset: In force.
        others: The other runs of the list.

    Raises:
        StemmapError: It cannot be searched so, and why.
    """
    if not digest:
        raise StemmapError("no run is open", remedy="Open one")
    if is_live(source.uri):
        raise StemmapError(
            "a live run cannot be mapped again and again", where=source.uri, remedy="Open its recording"
        )
    if truth is None or "tree" not in truth.kind:
        raise StemmapError("no true trees are known of this run", remedy="Annotate some in the tab Annotate")
    axes, goal = axes_of(asked.over), goal_of(asked.goal, asked.false_max)
    check(axes, parameters)
    own = PlannedRun(source.uri, TruthColumns.of(truth), "annotations", opened=source.request())
    return Plan(
        runs=(own, *_planned(asked, others)),
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
    """Look whether a stopped search would go on with what it began with.

    Raises:
        StemmapError: It would not, and what has changed since.
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
            raise StemmapError("true trees were edited since the search began", where=new.uri, remedy=remedy)
    if msgspec.structs.replace(stopped, storage="", preset=now.preset) != now:
        raise StemmapError("the runs were opened otherwise since the search began", remedy="Search again")


def _planned(asked: SearchAsked, others: Sequence[OtherRun]) -> list[PlannedRun]:
    by_record = {record: run for run in others for record in run.records}
    planned: list[PlannedRun] = []
    named: set[str] = set()
    for record, held_out in [(r, False) for r in asked.also] + [(r, True) for r in asked.held_out]:
        run = by_record.get(record)
        if run is None:
            raise StemmapError(
                "this is no other run of the list", where=f"run {record}", remedy="Load the list anew"
            )
        if run.why_not:
            raise StemmapError(run.why_not, where=run.name, remedy="Leave it out, or see to that first")
        if run.digest in named:
            raise StemmapError("a run is named twice", where=run.name, remedy="Name it once")
        named.add(run.digest)
        name = "annotations" if run.annotations.x else ""
        uri, said = run.opened.uri, run.annotations
        digest = "" if run.digest == uri else run.digest  # a source without one is known by its name
        planned.append(
            PlannedRun(uri, None, name, held_out, annotations=said, opened=run.opened, digest=digest)
        )
    if len(planned) > MOST_OTHERS:
        raise StemmapError(
            f"{count(len(planned), 'other run')} are too many",
            remedy=f"Name {MOST_OTHERS} at most, or use `stemmap tune`",
        )
    return planned


def _why_gone(uri: str) -> str:
    if is_live(uri):
        return "it was a live run, which cannot be mapped again"
    if uri.startswith("sim:"):
        return ""
    try:
        there = Path(uri.removeprefix("file://")).expanduser().exists()
    except (OSError, ValueError, RuntimeError):  # RuntimeError: a home of nobody
        there = False
    return "" if there else "its recording is not there any more"


def _why_no_truth(run: OtherRun, scored: bool) -> str:
    return "" if scored or "tree" in run.annotations.kind else "no true trees are known of it"
