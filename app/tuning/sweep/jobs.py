"""Jobs of a comparison: runs with their true trees, each with many parameter sets.

Jobs and results are sent to the workers and back as JSON: paths, parameters and scores, never point clouds.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import msgspec

import pipeline
from app.batch.run_folder import read_run, read_run_record
from app.common.text import count, version
from app.sources.opening import with_odometry
from app.sources.request import SourceRequest, request_of_kept
from app.tuning.plan import TruthTable
from app.tuning.sweep.grid import PRESET, words_of
from pipeline.config import Parameters
from pipeline.config.model import Value
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.io.readers import open_source
from pipeline.io.readers.clouds import is_cloud
from pipeline.types.records import TruthTrees

NO_TRUTH = "Give its true trees with --truth trees.csv, in the frame of the map"
#: Reason of a failure: "job" is the same on every worker; "worker" and "version" concern only this worker.
Fault = Literal["", "job", "worker", "version"]


class RunWithTruth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A run that is mapped and scored.

    Attributes:
        source: Source, and how it is mapped. A path is absolute and names the same recording on every worker.
        digest: SHA-256 of the source, by which a worker recognises another recording.
        truth: True trees in the frame of the map.
    """

    source: SourceRequest
    digest: str
    truth: TruthTable


class Job(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A run with one parameter set.

    Attributes:
        run: The run.
        parameters: All values, by stage and name.
        code: Digest of the code that made the job, see `code_digest`; other code may give other scores.
    """

    run: RunWithTruth
    parameters: dict[str, dict[str, Any]]
    code: str

    def key(self) -> str:
        """Return a SHA-256 (hex) of all that determines the scores, without the path of the recording."""
        source = msgspec.structs.replace(self.run.source, uri="")
        placeless = msgspec.structs.replace(self, run=msgspec.structs.replace(self.run, source=source))
        return hashlib.sha256(msgspec.json.encode(placeless, order="sorted")).hexdigest()


class JobResult(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The result of a job.

    Attributes:
        scores: Fields of `pipeline.evaluation.MapScores`, with the numbers of scans and trees; None after a
            failure.
        seconds: Computing time [s].
        looked: Whether the front end ran; False if its cached results were used.
        error: Reason of the failure.
        fault: Kind of the failure.
    """

    scores: dict[str, Any] | None
    seconds: float = 0.0
    looked: bool = False
    error: str = ""
    fault: Fault = ""


@cache
def code_digest() -> str:
    """Return the version and a SHA-256 of the sources of the pipeline."""
    assert pipeline.__file__ is not None  # noqa: S101 - the package has an __init__.py
    folder = Path(pipeline.__file__).parent
    state = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        if file.suffix in (".py", ".json"):
            state.update(f"{file.relative_to(folder).as_posix()}\0".encode() + file.read_bytes() + b"\0")
    return f"{version()}+{state.hexdigest()[:16]}"


# --- the plan of a comparison -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """A run that can be mapped and scored.

    Attributes:
        name: As the user named it.
        run: The run with its true trees.
        preset: Name of the preset that suits it.
    """

    name: str
    run: RunWithTruth
    preset: str


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """All jobs of a comparison.

    Attributes:
        runs: The runs, in the order in which they were named.
        sets: The combinations of parameter values.
        jobs: Jobs by number of the set and of the run.
        left_out: Sets whose values contradict one another for a run, by the same numbers, with the reason.
    """

    runs: tuple[PreparedRun, ...]
    sets: tuple[dict[str, Value], ...]
    jobs: dict[tuple[int, int], Job]
    left_out: dict[tuple[int, int], str]


def prepare_run(source: SourceRequest, truth: TruthTrees | None) -> PreparedRun:
    """Open a run and read its true trees.

    Args:
        source: The run; the URI may be a folder that `stemmap map` wrote, which names its source.
        truth: True trees that replace the source's own.

    Raises:
        StemmapError: It cannot be read, or has no true trees.
    """
    name, source = source.uri, _source_of(source)
    if is_cloud(source.uri):
        raise SourceError(
            "a whole cloud has no scans",
            where=source.uri,
            remedy='Drive through it: "sim:cloud?file=...&truth=..."',
        )
    with closing(open_source(source.uri, source.options())) as opened:
        with_motion, _ = with_odometry(opened, source.odometry)
        trees = truth or (known.trees if (known := opened.truth()) else None)
        if trees is None or not len(trees.x):
            raise StemmapError("the run has no true trees", where=name, remedy=NO_TRUTH)
        absolute = msgspec.structs.replace(source, uri=_absolute(source.uri))
        run = RunWithTruth(absolute, with_motion.description.digest, TruthTable.of(trees))
        return PreparedRun(name, run, opened.description.preset)


def plan_jobs(
    runs: Sequence[PreparedRun],
    sets: Sequence[dict[str, Value]],
    base: Callable[[PreparedRun, dict[str, Value]], Parameters],
) -> SweepPlan:
    """Return the jobs of all sets and runs.

    Args:
        runs, sets: What is combined.
        base: Returns the parameters that a combination changes, for a run.

    Raises:
        ParameterError: Every set contradicts itself.
    """
    jobs: dict[tuple[int, int], Job] = {}
    left_out: dict[tuple[int, int], str] = {}
    code = code_digest()
    for s, changes in enumerate(sets):
        values = {name: value for name, value in changes.items() if name != PRESET}
        for r, run in enumerate(runs):
            try:
                jobs[s, r] = Job(run.run, base(run, changes).replace(values).model_dump(), code)
            except ParameterError as error:
                left_out[s, r] = error.what
    if not jobs:
        (s, _), why = next(iter(left_out.items()))
        raise ParameterError(f"none of {count(len(sets), 'set')} can be used: {why}", where=words_of(sets[s]))
    return SweepPlan(tuple(runs), tuple(sets), jobs, left_out)


def _source_of(source: SourceRequest) -> SourceRequest:
    """Return the request of a run; for a folder that `stemmap map` wrote, that of its source with its
    choices."""
    folder = Path(source.uri)
    if not (folder / "run.json").is_file():
        return source
    run, record = read_run(folder), read_run_record(folder)
    if record.get("continued"):
        raise SourceError(
            "this map was made of several sources", where=source.uri, remedy="Name the sources themselves"
        )
    kept = request_of_kept(run.uri, odometry=source.odometry, seed=run.seed, choices=record.get("chosen"))
    return msgspec.structs.replace(
        kept, topics=source.topics or kept.topics, mount=source.mount or kept.mount
    )


def _absolute(uri: str) -> str:
    """Return a path as an absolute path, because workers run in other folders; other URIs unchanged."""
    try:
        path = Path(uri).expanduser()
        return str(path.absolute()) if path.exists() else uri
    except (OSError, RuntimeError, ValueError):
        return uri
