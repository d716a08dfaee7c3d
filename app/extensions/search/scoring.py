"""Maps and scores runs with one parameter set after another; the program of the scoring processes of a grid
comparison, a sensitivity curve or a search.

It receives `Job`s as lines of JSON and sends the `JobResult`s. The front end of the mapper depends on few
parameters. Its results are cached on disk under a key of those parameters, so that most sets need neither the
recording nor the points again.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path as FilePath

import msgspec

from app.batch.run_folder import NO_PATH, as_written, read_run, score_map
from app.common.child_process import ParentConnection, run_child
from app.dashboard.annotations import laid_over
from app.extensions.search.jobs import Job, JobResult, RunWithTruth
from app.extensions.search.plan import PlannedRun
from app.sources.one_step import OneStepSource, finish, open_one_step
from app.sources.request import SourceRequest, request_of_kept, with_odometry
from app.store.forests import kept_forests, mapper_of
from app.store.records import as_truth, contents_of
from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.errors import SourceError, StemmapError
from pipeline.io.readers import open_source
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.remapping.rerun import ScanCache, ScanCaches
from pipeline.types.records import Frame, Path, Step, Trees, TruthTrees

#: Points of the scans that are held in memory [bytes]; a longer run is read again when the front end runs.
_STEPS_LIMIT = 512 << 20


@dataclass(frozen=True, slots=True, eq=False)
class MappedRun:
    """The map of a run, with values as they are written to its files.

    Attributes:
        trees: The confirmed trees.
        path: One row per scan; empty without a drive.
        scans: Number of scans; 0 without a drive.
        front_end_ran: Whether the front end ran; False where its cached results were used. True without a
            drive.
    """

    trees: Trees
    path: Path
    scans: int
    front_end_ran: bool


class OpenDrive:
    """Scans of a robot or a simulated run, which can be mapped repeatedly.

    Args:
        source: What is mapped, and how.

    Attributes:
        digest, recording_digest: Digest of the source with and without the odometry.
        own_truth: True trees of the source; None if it has none.
        preset: Name of the preset that suits the source.

    Raises:
        StemmapError: The source cannot be read; nothing remains open.
    """

    def __init__(self, source: SourceRequest) -> None:
        self._uri, self._seed = source.uri, source.seed
        opened = open_source(source.uri, source.options())
        try:
            truth = opened.truth()
            self.own_truth = None if truth is None else truth.trees
            self._source, self._odometry = with_odometry(opened, source.odometry)
        except BaseException:
            opened.close()
            raise
        self.recording_digest = opened.description.digest
        self.digest = self._source.description.digest
        self.preset = self._source.description.preset
        self._steps: list[Step] | None = None
        self._caches = ScanCaches()
        self._scans = -1  # unknown before the first mapping

    def map(self, parameters: Parameters) -> MappedRun:
        """Map the run with these parameters, as `stemmap map` does.

        Results of the front end are read from the disk cache if an earlier call stored those of all scans
        under the same front-end parameters. Otherwise the front end runs and fills the cache.

        Raises:
            SourceError: There is no scan.
            StemmapError: The source or the cache cannot be read.
        """
        cache = self._caches.of(parameters)
        mapper = mapper_of(self._source.description, parameters, self._seed)
        is_cached = self._scans > 0 and cache.has_all(self._scans)
        frames = self._from_cache(mapper, cache) if is_cached else self._from_scans(mapper, cache)
        start_ns, frame = 0, None
        for frame in frames:
            if frame.index == 0:
                start_ns = frame.stamp_ns
        if frame is None:
            raise SourceError("there is no scan in it", where=self._uri)
        self._scans = frame.index + 1
        trees, path = as_written(frame.trees, mapper.path, start_ns)
        return MappedRun(trees, path, self._scans, not is_cached)

    def close(self) -> None:
        """Close the source and delete the caches."""
        self._caches.close()
        self._source.close()

    def _from_cache(self, mapper: Mapper, cache: ScanCache) -> Iterator[Frame]:
        """Yield the frames of all scans, with the cached results of the front end; raises StemmapError if one
        cannot be read."""
        for index in range(self._scans):
            cached = cache.read(index)
            if cached is None:
                raise StemmapError("a temporary file of cached scans is damaged", remedy="Start again")
            yield mapper.process(*cached)

    def _from_scans(self, mapper: Mapper, cache: ScanCache) -> Iterator[Frame]:
        """Yield the frames of all scans; the front end runs and its results are cached. When all frames were
        taken, the scans stay in memory for the next call if their points have at most `_STEPS_LIMIT`
        bytes."""
        held: list[Step] | None = []
        size = 0
        for step in self._read_steps():
            scan = mapper.segment(step)
            cache.put(step, scan)
            size += step.scan.points.nbytes
            if held is not None:
                held.append(step)
            if size > _STEPS_LIMIT:
                held = None
            yield mapper.process(step, scan)
        self._steps = held

    def _read_steps(self) -> Iterator[Step]:
        """Return the scans with their motion, from memory or from the source."""
        if self._steps is not None:
            return iter(self._steps)
        return steps(self._source.records(), odometry=self._odometry.steps)


class OpenOneStep:
    """A source that is mapped in one step, with the methods of `OpenDrive`. It has no path and no true trees
    of its own. Because it has no path, all true trees that are given count.

    Args:
        source: The source.
    """

    own_truth: TruthTrees | None = None
    preset = "forest"

    def __init__(self, source: OneStepSource) -> None:
        self._source = source
        self.digest = self.recording_digest = source.description.digest

    def map(self, parameters: Parameters) -> MappedRun:
        """Map the source with these parameters, as `stemmap map` does. Positions are in the frame of the
        file; `path` is empty and `scans` is 0.

        Raises:
            StemmapError: The source cannot be read or mapped.
        """
        found = finish(self._source.steps(parameters)).frame.trees
        placed = replace(found, position=found.position + self._source.about.offset[:2])
        trees, path = as_written(placed, NO_PATH, 0)
        return MappedRun(trees, path, 0, True)

    def close(self) -> None:
        """Close the source."""
        self._source.close()


OpenRun = OpenDrive | OpenOneStep


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


def open_run(source: SourceRequest) -> OpenRun:
    """Open a source. The caller closes it.

    Raises:
        StemmapError: The source cannot be read.
    """
    one_step = open_one_step(source.uri, source.options())
    return OpenDrive(source) if one_step is None else OpenOneStep(one_step)


def prepare_run(planned: PlannedRun) -> PreparedRun:
    """Open a run, read its true trees and close it.

    Args:
        planned: The run; its URI may be a folder that `stemmap map` wrote, which names its source.

    Raises:
        StemmapError: The run cannot be read, is another recording than the annotated one, or has no true
            trees; or the map of the folder was made of several sources.
    """
    name, source = planned.source.uri, _source_of(planned.source)
    with closing(open_run(source)) as run:
        if planned.digest and planned.digest not in (run.digest, run.recording_digest):
            raise SourceError(
                "this is another recording than the one that was annotated",
                where=name,
                remedy="Open it and annotate it, or leave it out",
            )
        if planned.truth is not None:
            truth: TruthTrees | None = as_truth(planned.truth)
        else:
            truth = run.own_truth
            if planned.annotations is not None:
                truth = laid_over(truth, planned.annotations)
        if truth is None or not len(truth.x):
            remedy = "Give its true trees with --truth trees.csv, in the frame of the map"
            if planned.annotations is not None:
                remedy = "Open it and annotate some in the tab Annotate, or leave it out"
            raise SourceError("the run has no true trees", where=name, remedy=remedy)
        return PreparedRun(name, RunWithTruth(source, run.digest, contents_of(truth)), run.preset)


def _source_of(source: SourceRequest) -> SourceRequest:
    """Return the request of a run: `source` itself, unless its URI is a folder that `stemmap map` wrote. For
    a folder, the request has the URI and the seed of the run in it, the odometry of `source`, and topics and
    mounting of `source` if given, else of the folder; preset and parameters are empty.

    Raises:
        SourceError: The map of the folder was made of several sources, or its files are damaged.
    """
    folder = FilePath(source.uri)
    if not (folder / "run.json").is_file():
        return source
    run = read_run(folder)
    if run.record.get("continued"):
        raise SourceError(
            "this map was made of several sources", where=source.uri, remedy="Name the sources themselves"
        )
    kept = request_of_kept(run.uri, odometry=source.odometry, seed=run.seed, choices=run.record.get("chosen"))
    return msgspec.structs.replace(
        kept, topics=source.topics or kept.topics, mount=source.mount or kept.mount
    )


class Scorer:
    """Scores jobs. The runs of the last jobs stay open; the one that was opened first is closed when there
    are too many.

    Args:
        runs: Number of runs that stay open; each may hold 0.5 GB of points.
    """

    def __init__(self, runs: int = 1) -> None:
        self._most = runs
        self._open: dict[bytes, OpenRun] = {}

    def score(self, job: Job) -> JobResult:
        """Return the result of a job. Every exception becomes its `error`, also that of another recording at
        the same path, or of an unknown forest."""
        begun = time.perf_counter()
        try:
            parameters = validated(job.parameters)
            kept_forests().check(parameters)
            mapped = self._run(job.run).map(parameters)
            scores = score_map(mapped.trees, mapped.path, as_truth(job.run.truth), parameters)
        except StemmapError as error:
            return JobResult(None, error=str(error))
        except MemoryError:
            return JobResult(None, error="this needs more memory than the machine has")
        except Exception as error:  # a fault with one set must not end the others
            return JobResult(None, error=f"this is a fault in stemmap: {type(error).__name__}: {error}")
        seconds = time.perf_counter() - begun
        return JobResult(scores, mapped.scans, len(mapped.trees.number), seconds, mapped.front_end_ran)

    def close(self) -> None:
        """Close the runs that are open."""
        while self._open:
            self._open.popitem()[1].close()

    def _run(self, requested: RunWithTruth) -> OpenRun:
        """Return the run, still open or newly opened; then the run that was opened first is closed if there
        are too many.

        Raises:
            StemmapError: The run cannot be opened, or is another recording than that of the job.
        """
        key = msgspec.json.encode([requested.source, requested.digest])
        if key not in self._open:
            if len(self._open) >= self._most:
                self._open.pop(next(iter(self._open))).close()
            run = open_run(requested.source)
            if run.digest != requested.digest:
                run.close()
                raise SourceError("the recording was replaced by another one", where=requested.source.uri)
            self._open[key] = run
        return self._open[key]


def main(words: list[str]) -> None:
    """Run the program of a scoring process: receive jobs and send their results until the parent ends, which
    ends this process. It never returns.

    Args:
        words: Arguments of the command line: --low-priority, --runs N.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("--low-priority", action="store_true")
    parser.add_argument("--runs", type=int, default=1, help="number of runs that stay open")
    arguments = parser.parse_args(words)
    scorer = Scorer(arguments.runs)

    def work(parent: ParentConnection) -> None:
        while True:
            parent.send(scorer.score(parent.receive(Job)))

    run_child(work, low_priority=arguments.low_priority)


if __name__ == "__main__":
    main(sys.argv[1:])
