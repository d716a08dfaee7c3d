"""Jobs: a run with its true trees that is mapped and scored with one parameter set.

Jobs and results are sent to the scoring processes and back as JSON: paths, parameters and scores, never point
clouds.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

import pipeline
from app.batch.summary import far_truth
from app.common.text import version
from app.robot.address import is_live
from app.sources.request import SourceRequest
from app.store.records import Content, contents_of
from pipeline.errors import StemmapError
from pipeline.evaluation import MapScores
from pipeline.types.records import TruthTrees


class RunWithTruth(msgspec.Struct, frozen=True):
    """A run that is mapped and scored.

    Attributes:
        source: Source, and how it is mapped.
        digest: SHA-256 of the source, by which another recording at the same path is recognised.
        truth: True trees in the frame of the map.
    """

    source: SourceRequest
    digest: str
    truth: list[Content]


class Job(msgspec.Struct, frozen=True):
    """A run with one parameter set.

    Attributes:
        run: The run.
        parameters: All values, by stage and name.
    """

    run: RunWithTruth
    parameters: dict[str, dict[str, Any]]

    def key(self) -> str:
        """Return a SHA-256 (hex) of all that determines the scores except the code, without the path of the
        recording."""
        source = msgspec.structs.replace(self.run.source, uri="")
        placeless = msgspec.structs.replace(self, run=msgspec.structs.replace(self.run, source=source))
        return hashlib.sha256(msgspec.json.encode(placeless, order="sorted")).hexdigest()


class JobResult(msgspec.Struct, frozen=True):
    """The result of a job.

    Attributes:
        scores: Scores of the map; None after a failure.
        scans, trees: Number of scans, and of trees in the map.
        seconds: Computing time [s].
        looked: Whether the front end ran; False if its cached results were used.
        error: Reason of the failure.
    """

    scores: MapScores | None
    scans: int = 0
    trees: int = 0
    seconds: float = 0.0
    looked: bool = False
    error: str = ""

    @property
    def problem(self) -> str:
        """Reason why the scores have no meaning, for people: a failure, or no ground truth near the path;
        empty otherwise."""
        if self.scores is not None and self.scores.TA.of + self.scores.TR.of == 0:
            return far_truth(self.scores.reach)
        return self.error


@cache
def code_digest() -> str:
    """Return the version and the first 16 hex digits of a SHA-256 of the sources (.py and .json) of the
    pipeline, as "version+digest". It is computed once per process."""
    assert pipeline.__file__ is not None  # noqa: S101 - the package has an __init__.py
    folder = Path(pipeline.__file__).parent
    state = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        if file.suffix in (".py", ".json"):
            state.update(f"{file.relative_to(folder).as_posix()}\0".encode() + file.read_bytes() + b"\0")
    return f"{version()}+{state.hexdigest()[:16]}"


def check_run(digest: str, uri: str, truth: TruthTrees | None) -> list[Content]:
    """Return the true trees and other objects of the open run, after a check that it can be mapped again and
    scored.

    Args:
        digest: Digest of the run; empty where none is open.
        uri: URI of its source.
        truth: Its true trees, with the annotations; None where none are known.

    Raises:
        StemmapError: No run is open, it is live, or its truth has no tree.
    """
    if not digest:
        raise StemmapError("no run is open", remedy="Open one")
    if is_live(uri):
        raise StemmapError("a live run cannot be mapped again", where=uri, remedy="Open its recording")
    if truth is None or "tree" not in truth.kind:
        raise StemmapError("no true trees are known of this run", remedy="Annotate some in the tab Annotate")
    return contents_of(truth)
