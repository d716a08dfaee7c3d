"""The records of a search: what is searched for, the runs with their true trees, and the trials."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import msgspec
import numpy as np

from app.common.version import version
from app.sources.request import SourceRequest
from app.tuning.goal import Goal, GoalName, RunScore
from app.tuning.search_space import Axis
from pipeline.config import Parameters
from pipeline.config.model import Value, validated
from pipeline.types.records import TruthTrees

FORMAT = 1
#: Prefix of the folder with the journal of a search of the page.
JOURNAL_FOLDER = "stemmap-search-"


class TruthTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """True trees as columns, for JSON. Lengths are metres; an unknown diameter is None."""

    x: list[float]
    y: list[float]
    dbh: list[float | None]
    kind: list[str]

    @classmethod
    def of(cls, trees: TruthTrees) -> TruthTable:
        """Convert arrays to a table."""
        dbh = [value if math.isfinite(value) else None for value in trees.dbh.tolist()]
        return cls(trees.x.tolist(), trees.y.tolist(), dbh, list(trees.kind))

    def trees(self) -> TruthTrees:
        """Convert the table to arrays."""
        dbh = [math.nan if value is None else value for value in self.dbh]
        x, y, diameter = (np.array(column, np.float64) for column in (self.x, self.y, dbh))
        return TruthTrees(x, y, diameter, tuple(self.kind))


class PlannedRun(msgspec.Struct, frozen=True):
    """A run of a search.

    Attributes:
        source: What is mapped, and how.
        truth: True trees; None for those that the source brings.
        truth_name: Name of the file that the true trees were read from, for the provenance.
        held_out: Whether the run is only scored, and does not guide the search.
        annotations: Annotations of a run of the page's list, which replace and extend the source's own trees.
        digest: Digest of the recording to which the annotations belong; empty for any.
    """

    source: SourceRequest
    truth: TruthTable | None = None
    truth_name: str = ""
    held_out: bool = False
    annotations: TruthTable | None = None
    digest: str = ""


class Plan(msgspec.Struct, frozen=True):
    """A search.

    Attributes:
        runs: At least one that is not held out.
        axes: The parameters that are searched, with their bounds.
        start: All parameters with which the search begins, by stage. They are the first trial.
        storage: Path of a journal, or address of a PostgreSQL database.
        preset: Name of the preset from which the parameters come.
        goal, false_max: See `app.tuning.goal.Goal`.
        seed: Random seed of the mapping and of the sampler.
        odometry: Default source of the motion, see `app.sources.opening`.
        trials: Number of trials in all, earlier ones included.
        seconds: Time limit [s]; 0 for none.
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
        """The parameters with which the search begins."""
        return validated({stage: dict(values) for stage, values in self.start.items()})

    @property
    def aim(self) -> Goal:
        """The goal of the search."""
        return Goal(self.goal, self.false_max)


class Trial(msgspec.Struct, frozen=True):
    """The result of one set of parameters.

    Attributes:
        number: Trials are numbered in the order in which they begin; -1 is the start of the search.
        values: The values that were tried, by parameter name.
        loss: See `Goal.loss`; None where the values contradict one another.
        training, held_out: Scores by run. Held-out runs are scored only for a set that is the best so far.
    """

    number: int
    values: dict[str, Value]
    loss: float | None
    training: tuple[RunScore, ...] = ()
    held_out: tuple[RunScore, ...] = ()


def identity(plan: Plan, digests: list[str]) -> dict[str, Any]:
    """Return all that decides the result of a trial. Searches with the same identity share their trials;
    neither the place of a recording nor the held-out runs belong to it.

    Args:
        plan: The search.
        digests: Digests of the runs that are not held out, with their true trees, in their order.
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


def digest_with_truth(plan: Plan, source: SourceRequest, digest: str, truth: TruthTrees) -> str:
    """Return one SHA-256 of a source, its true trees, and its choices where they differ from the plan's."""
    default = SourceRequest(source.uri, plan.odometry, plan.seed)
    chosen = [source.seed, source.odometry, source.topics, source.mount]
    differs = chosen != [default.seed, default.odometry, default.topics, default.mount]
    text = msgspec.json.encode([digest, TruthTable.of(truth), *([chosen] if differs else [])])
    return hashlib.sha256(text).hexdigest()
