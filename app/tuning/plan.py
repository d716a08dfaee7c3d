"""What a search is asked to do, as plain values that go from process to process."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import msgspec
import numpy as np

from app.common.version import version
from app.sources.request import SourceRequest
from app.tuning.goal import Goal, GoalName
from app.tuning.space import Axis
from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.types.records import TruthTrees

FORMAT = 1


class TruthColumns(msgspec.Struct, frozen=True):
    """True trees; lengths in metres, None where a diameter is not known."""

    x: list[float]
    y: list[float]
    dbh: list[float | None]
    kind: list[str]

    @classmethod
    def of(cls, trees: TruthTrees) -> TruthColumns:
        """From a record."""
        dbh = [value if math.isfinite(value) else None for value in trees.dbh.tolist()]
        return cls(trees.x.tolist(), trees.y.tolist(), dbh, list(trees.kind))

    def as_record(self) -> TruthTrees:
        """As a record."""
        dbh = np.array([math.nan if value is None else value for value in self.dbh], np.float64)
        return TruthTrees(np.array(self.x, np.float64), np.array(self.y, np.float64), dbh, tuple(self.kind))


class PlannedRun(msgspec.Struct, frozen=True):
    """A run to be searched over, or held out.

    Attributes:
        truth: None takes the source's own.
        truth_name: The file that the truth was read from, for the provenance.
        annotations: Of a run of the page's list: what people said of it, which lies over the source's own.
        opened: How the page opened it; None for the plan's own seed and odometry.
        digest: Of the source of which the annotations are; empty for any.
    """

    uri: str
    truth: TruthColumns | None = None
    truth_name: str = ""
    held_out: bool = False
    annotations: TruthColumns | None = None
    opened: SourceRequest | None = None
    digest: str = ""


class Plan(msgspec.Struct, frozen=True):
    """A search.

    Attributes:
        runs: At least one that is not held out.
        axes: What is searched over.
        goal, false_max: See `app.tuning.goal.Goal`.
        preset: Name of that from which the parameters come.
        start: All parameters with which the search begins, by stage; those of the axes are tried first.
        seed: Of the mapping and of the sampler.
        odometry: Where the motion of each run comes from, see `app.sources.opening`.
        trials: So many in all, those of earlier times counted.
        seconds: Stop after this time; 0 for none.
        storage: Path of a journal, or address of a PostgreSQL database.
    """

    runs: tuple[PlannedRun, ...]
    axes: tuple[Axis, ...]
    start: dict[str, dict[str, Any]]
    storage: str
    preset: str = "forest"
    goal: GoalName = "f1"
    false_max: float = 0.1
    seed: int = 0
    odometry: str = "auto"
    trials: int = 100
    seconds: float = 0.0

    @property
    def parameters(self) -> Parameters:
        """Those with which the search begins."""
        return validated({stage: dict(values) for stage, values in self.start.items()})

    @property
    def aim(self) -> Goal:
        """What is searched for."""
        return Goal(self.goal, self.false_max)


def identity(plan: Plan, digests: list[str]) -> dict[str, Any]:
    """What a journal is of: two searches share their trials where all of this is the same. Neither where the
    runs lie nor what is held out changes a trial.

    Args:
        plan: The search.
        digests: Of the runs that are not held out, with their truth, in their order.
    """
    return {
        "format": FORMAT,
        "version": version(),
        "runs": digests,
        "goal": [plan.goal, plan.false_max if plan.goal == "ta" else None],
        "parameters": [axis.words for axis in plan.axes],
        "start": plan.start,
        "seed": plan.seed,
        "odometry": plan.odometry,
    }


def digest_with_truth(digest: str, truth: TruthTrees, opened: SourceRequest | None = None) -> str:
    """One digest of a source, its truth, and how it is opened where that is not the plan's own way."""
    how = () if opened is None else ([opened.seed, opened.odometry, opened.topics, opened.mount],)
    text = msgspec.json.encode([digest, TruthColumns.of(truth), *how])
    return hashlib.sha256(text).hexdigest()
