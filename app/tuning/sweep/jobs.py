"""What is sent to a worker and what comes back, as JSON: paths, parameters and scores, never clouds."""

from __future__ import annotations

import hashlib
import math
from functools import cache
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from app.common.version import version
from pipeline.geometry.poses import Pose3
from pipeline.io.readers import SourceOptions
from pipeline.types.records import TruthTrees

PIPELINE = Path(__file__).resolve().parents[2] / "pipeline"
# What went wrong: of the job, wherever it is done; or of the worker, so that another may do it.
Fault = Literal["", "job", "worker", "version"]


class TruthTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """True trees as columns [m]; a diameter that is not known is None."""

    x: list[float]
    y: list[float]
    dbh: list[float | None]
    kind: list[str]

    @staticmethod
    def of(truth: TruthTrees) -> TruthTable:
        """From records."""
        return TruthTable(
            truth.x.tolist(),
            truth.y.tolist(),
            [dbh if math.isfinite(dbh) else None for dbh in truth.dbh.tolist()],
            list(truth.kind),
        )

    def trees(self) -> TruthTrees:
        """As records."""
        dbh = [math.nan if value is None else value for value in self.dbh]
        x, y, diameter = (np.array(column, np.float64) for column in (self.x, self.y, dbh))
        return TruthTrees(x, y, diameter, tuple(self.kind))


class RunAsked(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A run that is mapped, and what it is judged by.

    Attributes:
        uri: Of the source; a path is absolute, and leads to the same recording for every worker.
        digest: SHA-256 of what is read, so that a worker with another recording says so.
        seed: Of every random number.
        odometry: As asked, see `app.sources.opening`.
        topics: Chosen topic by role.
        mount: x, y, z [m], roll, pitch, yaw [deg] of the LiDAR on the robot; empty for what the source says.
        truth: The true trees in the frame of the map.
    """

    uri: str
    digest: str
    seed: int
    odometry: str
    topics: dict[str, str]
    mount: list[float]
    truth: TruthTable

    def options(self) -> SourceOptions:
        """With which the source is opened."""
        placed = (
            Pose3.from_euler(
                (self.mount[0], self.mount[1], self.mount[2]), *map(math.radians, self.mount[3:])
            )
            if self.mount
            else None
        )
        return SourceOptions(topics=dict(self.topics), T_base_lidar=placed, seed=self.seed)


class Job(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One run under one set of parameters.

    Attributes:
        parameters: All values, by stage and name.
        code: Of the program that asks; another one would give other scores, see `code_digest`.
    """

    run: RunAsked
    parameters: dict[str, dict[str, Any]]
    code: str

    def key(self) -> str:
        """SHA-256 (hex) of all that the scores hang on; where the recording lies is not among it."""
        asked = msgspec.structs.replace(self, run=msgspec.structs.replace(self.run, uri=""))
        return hashlib.sha256(msgspec.json.encode(asked, order="sorted")).hexdigest()


class Answer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What came of a job.

    Attributes:
        scores: See `pipeline.evaluation.Evaluation`, with how many scans and trees; None where it failed.
        seconds: That it took.
        looked: Whether its scans had to be looked at; else what was kept of them was used.
        error: Why it failed, in words.
    """

    scores: dict[str, Any] | None
    seconds: float = 0.0
    looked: bool = False
    error: str = ""
    fault: Fault = ""


@cache
def code_digest() -> str:
    """The version, and a SHA-256 of all that makes a map: other code's results are not taken for its own."""
    state = hashlib.sha256()
    for file in sorted(PIPELINE.rglob("*")):
        if file.suffix in (".py", ".json"):
            state.update(f"{file.relative_to(PIPELINE).as_posix()}\0".encode() + file.read_bytes() + b"\0")
    return f"{version()}+{state.hexdigest()[:16]}"
