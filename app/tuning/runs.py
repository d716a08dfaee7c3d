"""A run with its truth, mapped again and again with other parameters and scored each time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path as FilePath
from typing import Any, Protocol

import numpy as np

from app.batch.run_folder import as_written
from app.batch.run_totals import far_truth
from app.common.text import count
from app.dashboard.annotations import contents_of, laid_over
from app.sources.opening import with_odometry
from app.sources.request import SourceRequest
from app.store.records import Annotation
from app.training.learned_forests import kept_forests
from app.tuning.goal import RunScore, score_of
from app.tuning.plan import PlannedRun, digest_with_truth
from app.worker.mapper_factory import mapper_of
from app.worker.snapshots import Snapshots
from pipeline.config import Parameters
from pipeline.errors import SourceError, StemmapError
from pipeline.evaluation import Evaluation, evaluate
from pipeline.io.readers import open_source
from pipeline.io.readers.clouds import is_cloud, open_cloud
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.remapping import Basis, Journal, KeptScans, Rerun, look_key
from pipeline.types.records import Path, Step, Trees, TruthTrees

_HELD_BYTES = 512 << 20  # of points; a longer run is read again for what looks at its points anew
_KEPT_IN = FilePath("/var/tmp")  # noqa: S108 - the system's other place may be memory; the file has no name

Tick = Callable[[], None]


class ScoredRun(Protocol):
    """What a search needs of a run."""

    uri: str
    source_digest: str
    digest: str
    held_out: bool

    def evaluate(self, parameters: Parameters, tick: Tick) -> Evaluation: ...
    def close(self) -> None: ...


def open_runs(planned: tuple[PlannedRun, ...], seed: int, odometry: str) -> list[ScoredRun]:
    """Open the runs of a plan.

    Raises:
        SourceError: One cannot be read, or has no truth.
    """
    opened: list[ScoredRun] = []
    try:
        for run in planned:
            opened.append(_Plot(run) if is_cloud(run.uri) else _Drive(run, seed, odometry))
    except BaseException:
        for scored in opened:
            scored.close()
        raise
    return opened


def scores_of(runs: list[ScoredRun], parameters: Parameters, tick: Tick = lambda: None) -> list[RunScore]:
    """The score of each run."""
    return [score_of(run.evaluate(parameters, tick)) for run in runs]


def check_start(run: ScoredRun, evaluation: Evaluation, parameters: Parameters) -> None:
    """Look whether a run can be judged at all.

    Raises:
        StemmapError: Its truth has no tree near the path, or none that the start finds.
    """
    if not evaluation.TA.of:
        others = evaluation.TR.of > 0
        what = "the ground truth near the path has no trees" if others else far_truth(evaluation.reach)
        raise StemmapError(what, where=run.uri)
    if not evaluation.TA.count:
        raise StemmapError(
            f"none of {count(evaluation.TA.of, 'true tree')} has a mapped tree within "
            f"{parameters.evaluation.match_distance:g} m, with the parameters to begin with",
            where=run.uri,
            remedy="Check that the truth stands in the frame of the map (the first pose is its origin), or "
            "begin with another --preset",
        )


class _Drive:
    """Scans of a robot. What they show is looked at once, and again only for parameters that change it; and a
    trial begins where it differs from the first mapping."""

    def __init__(self, planned: PlannedRun, seed: int, odometry: str) -> None:
        self.uri, self.held_out = planned.uri, planned.held_out
        opened = planned.opened or SourceRequest(planned.uri, odometry, seed)
        self._seed = opened.seed
        self._source = open_source(planned.uri, opened.options())
        try:
            self._truth = _truth(planned, self._source.truth())
            self._moving, self._chosen = with_odometry(self._source, opened.odometry)
            digests = (self._source.description.digest, self._moving.description.digest)
            _check_source(planned, digests)
        except BaseException:
            self._source.close()
            raise
        self.source_digest = digests[1]
        self.digest = digest_with_truth(self.source_digest, self._truth, planned.opened)
        self._kept = KeptScans(_KEPT_IN if _KEPT_IN.is_dir() else None)
        self._held: list[Step] | None = None
        self._basis: Basis | None = None
        self._scans = 0
        self._start_ns = 0

    def evaluate(self, parameters: Parameters, tick: Tick) -> Evaluation:
        """Map the run as `stemmap map` does, and score its map."""
        mapper, trees = self._mapper(parameters), None
        if not self._scans:
            trees = self._first_time(mapper, tick)
        else:
            with closing(Rerun(mapper, self._kept, self._again, self._basis)) as rerun:
                for frame in rerun.frames(self._scans):
                    trees = frame.trees
                    tick()
        assert trees is not None  # noqa: S101 - there is a scan
        trees, path = as_written(trees, mapper.path, self._start_ns)
        return evaluate(trees, self._truth, parameters.evaluation, np.stack([path.x, path.y], axis=1))

    def close(self) -> None:
        self._kept.close()
        self._source.close()

    def _mapper(self, parameters: Parameters) -> Mapper:
        return mapper_of(self._moving.description, parameters, self._seed)

    def _first_time(self, mapper: Mapper, tick: Tick) -> Trees:
        """Map the run from its scans, and keep what they show."""
        key, trees, number = look_key(mapper.parameters), None, 0
        held: list[Step] | None = []
        size = 0
        journal, states = Journal(), Snapshots(mapper.snapshot())
        mapper.note = lambda noted: journal.note(noted, mapper.parameters.slam)
        run = steps(self._moving.records(), odometry=self._chosen.steps)
        step = next(run, None)
        before_last = mapper.snapshot()
        while step is not None:
            following = next(run, None)
            if following is None:  # the last scan is mapped in every trial, which asks it for its trees
                before_last = mapper.snapshot()
            looked = mapper.segment(step)
            self._kept.put(step, looked, key)
            frame = mapper.process(step, looked)
            trees, number = frame.trees, number + 1
            if number == 1:
                self._start_ns = frame.stamp_ns
            if states.is_due(number):
                states.offer(number, mapper.snapshot())
            size += step.scan.points.nbytes
            if held is not None:
                held.append(step)
            if size > _HELD_BYTES:
                held = None
            tick()
            step = following
        if trees is None:
            raise SourceError("there is no scan in it", where=self.uri)
        notes, path = journal.first(number - 1), mapper.path
        at = states.first(len(notes))
        if len(notes) == number - 1:
            at[number - 1] = before_last
        self._basis = Basis.of(mapper.parameters, notes, at, path, mapper.motion)
        self._scans, self._held = number, held
        return trees

    def _again(self) -> Iterator[Step]:
        if self._held is not None:
            return iter(self._held)
        return steps(self._moving.records(), odometry=self._chosen.steps)


class _Plot:
    """A whole cloud, which nobody drove through: all of the truth is asked for."""

    def __init__(self, planned: PlannedRun) -> None:
        self.uri, self.held_out = planned.uri, planned.held_out
        self._truth = _truth(planned, None)
        self.source_digest = open_cloud(planned.uri).description.digest
        _check_source(planned, (self.source_digest,))
        self.digest = digest_with_truth(self.source_digest, self._truth)

    def evaluate(self, parameters: Parameters, tick: Tick) -> Evaluation:
        """Map the cloud as `stemmap map` does, and score its map."""
        from dataclasses import replace

        from pipeline.inventory import map_plot

        cloud = open_cloud(self.uri)
        trees = map_plot(cloud, parameters, kept_forests()).trees
        tick()
        placed = replace(trees, position=trees.position + cloud.description.offset[:2])
        return evaluate(as_written(placed, _NO_PATH, 0)[0], self._truth, parameters.evaluation)

    def close(self) -> None:
        """Nothing is held."""


_NOTHING = np.zeros(0)
_NO_PATH = Path(_NOTHING.astype(np.int64), _NOTHING, _NOTHING, _NOTHING, _NOTHING)


def _truth(planned: PlannedRun, known: Any) -> TruthTrees:  # noqa: ANN401 - a Truth or None
    if planned.truth is not None:
        return planned.truth.as_record()
    if planned.annotations is not None:
        own = None if known is None else known.trees
        contents = contents_of(planned.annotations.as_record())
        truth = laid_over(own, [Annotation(k, content, "", 0, 1) for k, content in enumerate(contents)])
        if truth is None:
            remedy = "Open it and judge some in the tab Annotate, or leave it out"
            raise SourceError("no true trees are known of this run", where=planned.uri, remedy=remedy)
        return truth
    if known is None or known.trees is None:
        raise SourceError(
            "the run brings no true trees",
            where=planned.uri,
            remedy=f"Give them with --truth {planned.uri}=trees.csv",
        )
    trees: TruthTrees = known.trees
    return trees


def _check_source(planned: PlannedRun, digests: tuple[str, ...]) -> None:
    """Annotations are of what was recorded, and not of whatever has its name now.

    Raises:
        SourceError: It is another recording.
    """
    if planned.digest and planned.digest not in digests:
        raise SourceError(
            "this is not what was mapped before: another recording has its name",
            where=planned.uri,
            remedy="Open it and annotate it, or leave it out",
        )
