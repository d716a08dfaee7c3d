"""From what a person names to jobs: each run opened once, its truth read, the sets of parameters laid out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from app.batch.run_folder import read_run, read_run_record
from app.common.text import count
from app.sources.opening import with_odometry
from app.tuning.sweep.grid import laid_over, words_of
from app.tuning.sweep.jobs import Job, RunAsked, TruthTable, code_digest
from pipeline.config import Parameters
from pipeline.config.model import Value
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.io.readers import open_source
from pipeline.io.readers.clouds import is_cloud
from pipeline.types.records import TruthTrees

NO_TRUTH = "Give its true trees with --truth trees.csv, in the frame of the map"


@dataclass(frozen=True, slots=True)
class Named:
    """A run as a person named it.

    Attributes:
        name: A source, or a folder that `stemmap map` wrote, which names its source.
        odometry, topics, mount, seed: As for `RunAsked`.
        truth: True trees in place of the source's own.
    """

    name: str
    seed: int
    odometry: str
    topics: dict[str, str]
    mount: tuple[float, ...]
    truth: TruthTrees | None


@dataclass(frozen=True, slots=True)
class Ready:
    """A run that can be mapped, and the preset that suits it."""

    name: str
    asked: RunAsked
    preset: str


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be done.

    Attributes:
        runs: In the order in which they were named.
        sets: The combinations.
        jobs: By number of the set and of the run.
        left_out: Sets that cannot be for a run, by its number and theirs: why.
    """

    runs: tuple[Ready, ...]
    sets: tuple[dict[str, Value], ...]
    jobs: dict[tuple[int, int], Job]
    left_out: dict[tuple[int, int], str]


def ready(named: Named) -> Ready:
    """Open the run and read its truth.

    Raises:
        StemmapError: It cannot be read, or knows no true trees.
    """
    uri, seed = _source_of(named)
    if is_cloud(uri):
        raise SourceError(
            "a whole cloud has no scans", where=uri, remedy='Drive through it: "sim:cloud?file=...&truth=..."'
        )
    options = RunAsked(
        uri, "", seed, named.odometry, named.topics, list(named.mount), TruthTable([], [], [], [])
    ).options()
    with closing(open_source(uri, options)) as source:
        moving, _ = with_odometry(source, named.odometry)
        truth = named.truth or (known.trees if (known := source.truth()) else None)
        if truth is None or not len(truth.x):
            raise StemmapError("the run knows no true trees", where=named.name, remedy=NO_TRUTH)
        asked = RunAsked(
            _everywhere(uri),
            moving.description.digest,
            seed,
            named.odometry,
            named.topics,
            list(named.mount),
            TruthTable.of(truth),
        )
        return Ready(named.name, asked, source.description.preset)


def planned(
    runs: Sequence[Ready],
    sets: Sequence[dict[str, Value]],
    base: Callable[[Ready, dict[str, Value]], Parameters],
) -> Plan:
    """All jobs.

    Args:
        runs, sets: What is combined.
        base: The parameters that a combination is laid over, for a run.

    Raises:
        ParameterError: Not a single set can be.
    """
    jobs: dict[tuple[int, int], Job] = {}
    left_out: dict[tuple[int, int], str] = {}
    code = code_digest()
    for s, changes in enumerate(sets):
        for r, run in enumerate(runs):
            try:
                jobs[s, r] = Job(run.asked, laid_over(base(run, changes), changes).model_dump(), code)
            except ParameterError as error:
                left_out[s, r] = error.what
    if not jobs:
        (s, _), why = next(iter(left_out.items()))
        raise ParameterError(f"none of {count(len(sets), 'set')} can be: {why}", where=words_of(sets[s]))
    return Plan(tuple(runs), tuple(sets), jobs, left_out)


def _source_of(named: Named) -> tuple[str, int]:
    """URI and seed; of a folder that `stemmap map` wrote those of its source."""
    folder = Path(named.name)
    if not (folder / "run.json").is_file():
        return named.name, named.seed
    run, record = read_run(folder), read_run_record(folder)
    if record.get("continued"):
        raise SourceError(
            "this map was made of several sources", where=named.name, remedy="Name the sources themselves"
        )
    return run.uri, run.seed


def _everywhere(uri: str) -> str:
    """A path as workers in other folders find it; what is no path stays."""
    try:
        path = Path(uri).expanduser()
        return str(path.absolute()) if path.exists() else uri
    except (OSError, RuntimeError, ValueError):
        return uri
