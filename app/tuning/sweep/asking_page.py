"""What the page asks of the run that it shows."""

from __future__ import annotations

from app.sources.request import SourceRequest
from app.tuning.sweep.jobs import RunAsked, TruthTable
from app.tuning.sweep.sensitivity import Question
from app.worker.protocol import Status
from pipeline.config import Parameters
from pipeline.config.model import Value
from pipeline.errors import StemmapError
from pipeline.types.records import TruthTrees


def question_of(
    source: SourceRequest,
    digest: str,
    status: Status,
    truth: TruthTrees | None,
    parameters: Parameters,
    name: str,
    values: list[Value],
) -> Question:
    """How much a parameter matters in a run.

    Args:
        source, digest, status: Of the run.
        truth: True trees, annotations among them.
        parameters: In force.
        name, values: What is asked for, in this order.

    Raises:
        StemmapError: The run cannot be read again, or there is nothing to score it by.
    """
    if not digest:
        raise StemmapError("no run is open", remedy="Open one")
    if status.live:
        raise StemmapError("a live run cannot be read again", remedy="Open the recording of it")
    if truth is None or not len(truth.x):
        raise StemmapError(
            "there are no true trees to score by",
            remedy="Judge some trees in the tab Annotate, or import a table",
        )
    mount = source.for_page()["mount"] or []
    table = TruthTable.of(truth)
    run = RunAsked(source.uri, digest, source.seed, source.odometry, dict(source.topics), mount, table)
    return Question(run, parameters, name, tuple(values))
