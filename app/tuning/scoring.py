"""Maps and scores runs with one parameter set after another; the program of the worker processes of a grid
comparison, a sensitivity curve or a search.

It receives `Job`s as lines of JSON and sends the `JobResult`s. The front end of the mapper depends on few
parameters. Its results are cached on disk under a key of those parameters, so that most sets need neither the
recording nor the points again.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import IO

import msgspec

import pipeline.jit
from app.batch.run_folder import NO_PATH, as_written, score_map
from app.common.child_process import ParentConnection, run_child
from app.sources.request import SourceRequest, with_odometry
from app.store.forests import kept_forests
from app.store.records import as_truth
from app.tuning.jobs import Fault, Job, JobResult, RunWithTruth, code_digest
from app.worker.mapper_factory import mapper_of
from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.io.readers import open_source
from pipeline.io.readers.clouds import is_cloud, open_cloud
from pipeline.jit import on_compiling
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.remapping import ScanCache, ScanCaches
from pipeline.types.records import Frame, Path, Step, Trees, TruthTrees

#: Points of the scans that are held in memory [bytes]; a longer run is read again when the front end runs.
_STEPS_LIMIT = 512 << 20
# The temporary folder of the system may be in memory. The file has no name.
_CACHE_FOLDER = FilePath("/var/tmp")  # noqa: S108


@dataclass(frozen=True, slots=True, eq=False)
class MappedRun:
    """The map of a run, with values as they are written to its files.

    Attributes:
        trees: The confirmed trees.
        path: One row per scan; empty for a whole cloud.
        scans: Number of scans.
        front_end_ran: Whether the front end ran; False where its cached results were used.
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
        digest: Digest of the source with its odometry; recording_digest: without.
        own_truth: True trees of the source; None if it has none.
        preset: Name of the preset that suits the source.

    Raises:
        StemmapError: It cannot be read; nothing remains open.
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
        self._caches = ScanCaches(_CACHE_FOLDER if _CACHE_FOLDER.is_dir() else None)
        self._scans = -1  # unknown before the first mapping

    def map(self, parameters: Parameters) -> MappedRun:
        """Map the run with these parameters, as `stemmap map` does.

        Results of the front end are read from the disk cache if an earlier call stored those of all scans
        under the same front-end parameters. Otherwise the front end runs and fills the cache.

        Raises:
            SourceError: There is no scan.
            StemmapError: The source cannot be read.
        """
        cache, mapper = self._caches.of(parameters), self._mapper(parameters)
        if self._scans > 0 and cache.has_all(self._scans):
            with contextlib.suppress(_DamagedCacheError):
                return self._mapped(mapper, self._from_cache(mapper, cache), front_end_ran=False)
            mapper = self._mapper(parameters)
        mapped = self._mapped(mapper, self._from_scans(mapper, cache), front_end_ran=True)
        self._scans = mapped.scans
        return mapped

    def close(self) -> None:
        """Close the source and delete the caches."""
        self._caches.close()
        self._source.close()

    def _mapper(self, parameters: Parameters) -> Mapper:
        """Return a mapper of the source before its first scan."""
        return mapper_of(self._source.description, parameters, self._seed)

    def _mapped(self, mapper: Mapper, frames: Iterator[Frame], *, front_end_ran: bool) -> MappedRun:
        """Consume the frames and return the map after the last one; raises SourceError without a frame.

        Args:
            mapper: The mapper that makes the frames.
            frames: One frame per scan; the scans are mapped while it is consumed.
            front_end_ran: As in `MappedRun`.
        """
        start_ns, frame = 0, None
        for frame in frames:
            if frame.index == 0:
                start_ns = frame.stamp_ns
        if frame is None:
            raise SourceError("there is no scan in it", where=self._uri)
        trees, path = as_written(frame.trees, mapper.path, start_ns)
        return MappedRun(trees, path, frame.index + 1, front_end_ran)

    def _from_cache(self, mapper: Mapper, cache: ScanCache) -> Iterator[Frame]:
        """Yield the frames of all scans, with the cached results of the front end; raises
        `_DamagedCacheError` if one cannot be read."""
        for index in range(self._scans):
            cached = cache.read(index)
            if cached is None:  # the source still has the scan
                raise _DamagedCacheError
            yield mapper.process(*cached)

    def _from_scans(self, mapper: Mapper, cache: ScanCache) -> Iterator[Frame]:
        """Yield the frames of all scans; the front end runs and its results are cached. The scans stay in
        memory for the next call if their points have at most `_STEPS_LIMIT` bytes."""
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


class OpenCloud:
    """A whole cloud of a plot, with the methods of `OpenDrive`. It has no path and no true trees of its own.
    Because it has no path, all true trees that are given count.

    Raises:
        StemmapError: The cloud cannot be read.
    """

    own_truth: TruthTrees | None = None
    preset = "forest"

    def __init__(self, source: SourceRequest) -> None:
        self._uri = source.uri
        self.digest = self.recording_digest = open_cloud(source.uri).description.digest

    def map(self, parameters: Parameters) -> MappedRun:
        """Map the cloud with these parameters, as `stemmap map` does. The file is read at each call.
        Positions are in the frame of the file; `path` is empty and `scans` is 0.

        Raises:
            StemmapError: The cloud cannot be read or mapped.
        """
        from pipeline.inventory import map_plot

        cloud = open_cloud(self._uri)
        found = map_plot(cloud, parameters, kept_forests()).trees
        placed = replace(found, position=found.position + cloud.description.offset[:2])
        trees, path = as_written(placed, NO_PATH, 0)
        return MappedRun(trees, path, 0, True)

    def close(self) -> None:
        """Do nothing: no file is open."""


class _DamagedCacheError(Exception):
    """A cached scan cannot be read."""


OpenRun = OpenDrive | OpenCloud


def open_run(source: SourceRequest) -> OpenRun:
    """Open a source. The caller closes it.

    Raises:
        StemmapError: It cannot be read.
    """
    return OpenCloud(source) if is_cloud(source.uri) else OpenDrive(source)


class NotHereError(StemmapError):
    """The recording or the random forest is missing on this worker; another worker may have it."""


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
        """Return the result of a job; every exception becomes its `error`. The fault is "version" if the job
        was made by other code, "worker" if the recording or the forest is missing here, otherwise "job"."""
        if job.code != code_digest():
            other = f"this worker has stemmap {code_digest()}, the job comes from {job.code}"
            return _failed(f"{other}. Install the same version on both", "version")
        begun = time.perf_counter()
        try:
            parameters = validated(job.parameters)
            with _errors_of_this_worker():
                kept_forests().check(parameters)  # learned forests are in the data folder of each machine
            mapped = self._run(job.run).map(parameters)
        except NotHereError as error:
            return _failed(str(error), "worker")
        except StemmapError as error:
            return _failed(str(error))
        except MemoryError:
            return _failed("this needs more memory than the machine has")
        except Exception as error:  # a fault with one set must not end the others
            return _failed(f"this is a fault in stemmap: {type(error).__name__}: {error}")
        scores = score_map(mapped.trees, mapped.path, as_truth(job.run.truth), parameters)
        seconds = time.perf_counter() - begun
        return JobResult(scores, mapped.scans, len(mapped.trees.number), seconds, mapped.front_end_ran)

    def close(self) -> None:
        """Close the runs that are open."""
        while self._open:
            self._open.popitem()[1].close()

    def _run(self, requested: RunWithTruth) -> OpenRun:
        """Return an open run, from memory or newly opened.

        Raises:
            NotHereError: It cannot be opened on this worker, or is another recording.
            ParameterError: The request is invalid on every worker.
        """
        key = msgspec.json.encode([requested.source, requested.digest])
        if key not in self._open:
            if len(self._open) >= self._most:
                self._open.pop(next(iter(self._open))).close()
            self._open[key] = _opened(requested)
        return self._open[key]


_scorer = Scorer()  # of a worker of a cluster, which may have several threads
_scorer_lock = threading.Lock()


def score_json(text: bytes) -> bytes:
    """Return the result of a job on a worker of a cluster, both as JSON. One job at a time is computed in
    this process. Invalid JSON gives a result with the fault "version"."""
    try:
        job = msgspec.json.decode(text, type=Job)
    except msgspec.MsgspecError as error:
        return msgspec.json.encode(_failed(f"this is not a job: {error}", "version"))
    with _scorer_lock, one_compiler_at_a_time():
        return msgspec.json.encode(_scorer.score(job))


@contextlib.contextmanager
def one_compiler_at_a_time() -> Iterator[None]:
    """Inside, a kernel that must be compiled waits until no other worker of this machine compiles. The second
    worker then finds the compiled kernel. The lock is held from the first compilation to the end of the
    block; Windows has no lock."""
    with contextlib.ExitStack() as stack:
        held: list[IO[bytes]] = []

        def wait() -> None:
            if not held:
                held.append(stack.enter_context(FilePath(pipeline.jit.__file__).open("rb")))
                _lock(held[0])

        with on_compiling(wait):
            yield


def _lock(file: IO[bytes]) -> None:
    """Wait for an exclusive lock of an open file, which ends when the file is closed; does nothing on
    Windows."""
    if sys.platform != "win32":
        import fcntl

        fcntl.flock(file.fileno(), fcntl.LOCK_EX)


def _opened(requested: RunWithTruth) -> OpenRun:
    """Open a run and check its digest.

    Raises:
        NotHereError: It cannot be opened here, or is another recording than that of the job.
        ParameterError: The request is invalid on every worker.
    """
    with _errors_of_this_worker():
        run = open_run(requested.source)
    if run.digest != requested.digest:
        run.close()
        raise NotHereError(
            "this worker has another recording of that name",
            where=requested.source.uri,
            remedy="All workers must have the same file at this place",
        )
    return run


@contextlib.contextmanager
def _errors_of_this_worker() -> Iterator[None]:
    """Raise what is missing here as NotHereError; errors of parameters are the same on every worker."""
    try:
        yield
    except ParameterError:
        raise
    except StemmapError as error:
        raise NotHereError(error.what, where=error.where, remedy=error.remedy) from None


def _failed(error: str, fault: Fault = "job") -> JobResult:
    """Return a result without scores."""
    return JobResult(None, error=error, fault=fault)


def main(words: list[str]) -> None:
    """Receive jobs and send their results until the parent ends; the program of a child process.

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
            job = parent.receive(Job)
            with one_compiler_at_a_time():
                parent.send(scorer.score(job))

    run_child(work, low_priority=arguments.low_priority)


if __name__ == "__main__":
    main(sys.argv[1:])
