"""Scores one run under one set of parameters after the other; its scans are looked at once for all sets that
look at them in the same way."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

import msgspec
import numpy as np

from app.batch.run_folder import as_written
from app.batch.run_totals import far_truth
from app.sources.opening import Chosen, with_odometry
from app.training.learned_forests import kept_forests
from app.tuning.sweep.compiling import one_at_a_time
from app.tuning.sweep.jobs import Answer, Fault, Job, RunAsked, code_digest
from app.worker.mapper_factory import mapper_of
from app.worker.snapshots import Snapshots
from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.errors import ParameterError, StemmapError
from pipeline.evaluation import evaluate
from pipeline.io.readers import Source, open_source
from pipeline.mapper import Mapper, MapperState
from pipeline.odometry.synchroniser import steps
from pipeline.remapping import Basis, Journal, KeptScans, Rerun, look_key
from pipeline.types.records import Path, Trees

_MOST_KEPT = 2  # ways of looking at a run whose scans are kept at once
_DISK = FilePath("/var/tmp")  # noqa: S108 - the system's other place may be memory; the file has no name


class NotHereError(StemmapError):
    """The run, or what it is mapped with, cannot be had in this place; another worker may have it."""


class Scorer:
    """Keeps the run that it scored last open, with what its scans showed."""

    def __init__(self) -> None:
        self._run: _OpenRun | None = None

    def score(self, job: Job) -> Answer:
        """Map and judge; what goes wrong is told in the answer."""
        if job.code != code_digest():
            other = f"this worker runs stemmap {code_digest()}, and was asked by {job.code}"
            return Answer(None, error=f"{other}. Install the same version on both", fault="version")
        begun = time.perf_counter()
        try:
            parameters = validated(job.parameters)
            _check_forest(parameters)
            if self._run is None or self._run.asked != job.run:
                self.close()
                self._run = _OpenRun(job.run)
            scores, looked = self._run.score(parameters)
        except NotHereError as error:
            return _failed(str(error), "worker")
        except StemmapError as error:
            return _failed(str(error))
        except MemoryError:
            return _failed("this needs more memory than the machine has")
        except Exception as error:  # a fault in one set must not end the others
            return _failed(f"this is a fault in stemmap: {type(error).__name__}: {error}")
        return Answer(scores, time.perf_counter() - begun, looked)

    def close(self) -> None:
        """Let go of the run."""
        if self._run is not None:
            self._run.close()
            self._run = None


def _check_forest(parameters: Parameters) -> None:
    """Learned decision trees lie in the data folder of each machine, and another worker may have them."""
    try:
        kept_forests().check(parameters)
    except StemmapError as error:
        raise NotHereError(error.what, where=error.where, remedy=error.remedy) from None


def _failed(error: str, fault: Fault = "job") -> Answer:
    return Answer(None, error=error, fault=fault)


_here: list[Scorer] = []  # of a process that is asked again and again
_one = threading.Lock()


def score_text(text: bytes) -> bytes:
    """The answer to a job, both as JSON. What was opened for the last one is kept open for the next."""
    try:
        job = msgspec.json.decode(text, type=Job)
    except msgspec.MsgspecError as error:
        return msgspec.json.encode(_failed(f"this is no job: {error}", "version"))
    with _one, one_at_a_time():  # a worker of a cluster may have several threads
        if not _here:
            _here.append(Scorer())
        return msgspec.json.encode(_here[0].score(job))


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What is known of a run that was looked at in one way.

    Attributes:
        kept: Of each scan.
        basis: The run as it was mapped last.
    """

    kept: KeptScans
    basis: Basis


class _OpenRun:
    def __init__(self, asked: RunAsked) -> None:
        self.asked = asked
        self._source, self._chosen = _opened(asked)
        self._seen: dict[bytes, _Seen] = {}
        self._scans = -1  # not known before all were read once
        self._start_ns = 0
        self._truth = asked.truth.trees()

    def score(self, parameters: Parameters) -> tuple[dict[str, Any], bool]:
        """The scores, and whether the scans were looked at."""
        key = look_key(parameters)
        seen = self._seen.get(key)
        if seen is not None and len(seen.kept) == self._scans:
            with suppress(_DamagedError):
                return self._judged(*self._again(parameters, seen, key), parameters), False
        return self._judged(*self._anew(parameters, key), parameters), True

    def close(self) -> None:
        """Let go of the source and of what was kept."""
        for key in list(self._seen):
            self._forget(key)
        self._source.close()

    def _mapper(self, parameters: Parameters) -> Mapper:
        return mapper_of(self._source.description, parameters, self.asked.seed)

    def _again(self, parameters: Parameters, seen: _Seen, key: bytes) -> tuple[Path, Trees]:
        """The map from what is kept of the scans, begun where these parameters act."""
        basis = seen.basis
        rerun = Rerun(self._mapper(parameters), seen.kept, None, basis)
        states = Snapshots(basis.states[0] if rerun.passed else rerun.state())
        for scans, state in sorted(basis.states.items()):
            if scans <= rerun.passed:
                states.offer(scans, state)
        trees: Trees | None = None
        try:
            while rerun.done < self._scans:
                if states.is_due(rerun.done) and (known := rerun.state()) is not None:
                    states.offer(rerun.done, known)
                for frame in rerun.frames(states.next_due(rerun.done, self._scans)):
                    trees = frame.trees
        except StemmapError as error:  # what was kept is damaged: the source still has it
            raise _DamagedError(str(error)) from None
        assert trees is not None  # noqa: S101 - a basis ends before the last scan
        self._seen[key] = _Seen(seen.kept, self._basis(rerun.mapper, rerun.journal, states))
        return rerun.mapper.path, trees

    def _anew(self, parameters: Parameters, key: bytes) -> tuple[Path, Trees]:
        """The map from the scans themselves."""
        self._forget(key)
        while len(self._seen) >= _MOST_KEPT:
            self._forget(next(iter(self._seen)))
        kept, journal = KeptScans(_DISK if _DISK.is_dir() else None), Journal()
        mapper, trees, scans = self._mapper(parameters), None, 0
        mapper.note = lambda noted: journal.note(noted, parameters.slam)
        states: Snapshots[MapperState | None] = Snapshots(mapper.snapshot())
        for step in steps(self._source.records(), odometry=self._chosen.steps):
            if states.is_due(scans):
                states.offer(scans, mapper.snapshot())
            looked = mapper.segment(step)
            kept.put(step, looked, key)
            trees = mapper.process(step, looked).trees
            if not scans:
                self._start_ns = step.scan.stamp_ns
            scans += 1
        if trees is None:
            kept.close()
            raise StemmapError("there is no scan in it", where=self.asked.uri)
        self._scans = scans
        self._seen[key] = _Seen(kept, self._basis(mapper, journal, states))
        return mapper.path, trees

    def _basis(self, mapper: Mapper, journal: Journal, states: Snapshots[MapperState | None]) -> Basis:
        path, last = mapper.path, self._scans - 1
        known = {scans: state for scans, state in states.first(last).items() if state is not None}
        return Basis.of(mapper.parameters, journal.first(last), known, path, mapper.motion)

    def _forget(self, key: bytes) -> None:
        if key in self._seen:
            self._seen.pop(key).kept.close()

    def _judged(self, driven: Path, found: Trees, parameters: Parameters) -> dict[str, Any]:
        """As `stemmap map` scores, and `stemmap evaluate` what that has written."""
        trees, path = as_written(found, driven, self._start_ns)
        path_xy = np.stack([path.x, path.y], axis=1)
        evaluation = evaluate(trees, self._truth, parameters.evaluation, path_xy)
        if evaluation.TA.of + evaluation.TR.of == 0:
            raise StemmapError(far_truth(evaluation.reach))
        return {**asdict(evaluation), "scans": self._scans, "trees": len(trees.number)}


class _DamagedError(Exception):
    """What was kept of the scans cannot be used."""


def _opened(asked: RunAsked) -> tuple[Source, Chosen]:
    """The source, that was opened elsewhere already."""
    try:
        source = open_source(asked.uri, asked.options())
    except ParameterError:
        raise
    except StemmapError as error:
        raise NotHereError(error.what, where=error.where, remedy=error.remedy) from None
    try:
        moving, chosen = with_odometry(source, asked.odometry)
        if moving.description.digest != asked.digest:
            raise NotHereError(
                "the recording is another one than where it was asked for",
                where=asked.uri,
                remedy="All workers must have the same file at this place",
            )
    except BaseException:
        source.close()
        raise
    return moving, chosen
