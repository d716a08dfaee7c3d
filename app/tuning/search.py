"""The search: Optuna suggests a parameter set, the runs are mapped with it, and the scores are stored.

A trial depends only on the trials before it, its number and the seed. A stopped search therefore continues
with the trials that it would have made, and with one worker the same input gives the same result.
"""

from __future__ import annotations

import os
import shutil
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from app.batch.summary import far_truth
from app.common.child_process import BlockingChildProcess, ParentConnection, python_module, run_child
from app.common.text import count
from app.dashboard.annotations import contents_of, laid_over
from app.store.records import Annotation
from app.tuning.plan import (
    JOURNAL_FOLDER,
    Plan,
    PlannedRun,
    RunScore,
    Trial,
    check,
    digest_with_truth,
    identity,
    pool,
    score_of,
    values_of,
)
from app.tuning.result import SearchMessage, best_of, result_of
from app.tuning.scored_runs import OpenRun, Tick, open_run
from app.tuning.storage import OtherSearchError, close_storage, open_study
from pipeline.config import Parameters
from pipeline.config.model import Value
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.evaluation import MapScores
from pipeline.types.records import TruthTrees

_ABANDONED_S = 1800.0  # a silent trial of another machine is repeated after this time
_UNNAMED_S = 60.0  # the same for a trial whose process ended before it stored its name
_STOP_CHECK_S = 0.2
_FIXED = "fixed_params"  # Optuna's attribute of a trial whose values were given


class StoppedError(Exception):
    """The search was stopped during a trial. The trial is repeated when the search continues."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchRun:
    """A run of a search, opened.

    Attributes:
        uri, held_out: As planned.
        source_digest: Digest of the source.
        digest: Digest of the source, how it is opened and its true trees.
    """

    uri: str
    held_out: bool
    source_digest: str
    digest: str
    run: OpenRun
    truth: TruthTrees

    def evaluate(self, parameters: Parameters, tick: Tick) -> MapScores:
        """Return the scores of the run, mapped with these parameters.

        Args:
            parameters: All parameters.
            tick: Called after each scan; may raise an exception to stop.
        """
        return self.run.map(parameters, tick).evaluate(self.truth, parameters)


def open_runs(plan: Plan) -> list[SearchRun]:
    """Open the runs of a plan.

    Raises:
        SourceError: A run cannot be read, or has no true trees.
    """
    opened: list[SearchRun] = []
    try:
        for planned in plan.runs:
            opened.append(_open(plan, planned))
    except BaseException:
        for each in opened:
            each.run.close()
        raise
    return opened


def scores_of(runs: Sequence[SearchRun], parameters: Parameters, tick: Tick = lambda: None) -> list[RunScore]:
    """Return the score of each run, mapped with these parameters; `tick` as in `SearchRun.evaluate`."""
    return [score_of(run.evaluate(parameters, tick)) for run in runs]


def check_start(run: SearchRun, evaluation: MapScores, parameters: Parameters) -> None:
    """Check that a run can be scored at all.

    Args:
        run: The run.
        evaluation: Scores of its first map.
        parameters: Parameters of that map.

    Raises:
        StemmapError: No true tree is near the path, or the map has none of them.
    """
    if not evaluation.TA.of:
        others = evaluation.TR.of > 0
        what = "the ground truth near the path has no trees" if others else far_truth(evaluation.reach)
        raise StemmapError(what, where=run.uri)
    if not evaluation.TA.count:
        raise StemmapError(
            f"none of {count(evaluation.TA.of, 'true tree')} has a mapped tree within "
            f"{parameters.evaluation.match_distance:g} m, with the parameters that the search begins with",
            where=run.uri,
            remedy="Check that the true trees are in the frame of the map (the first pose is its origin), or "
            "begin with another --preset",
        )


def _open(plan: Plan, planned: PlannedRun) -> SearchRun:
    run = open_run(planned.source)
    try:
        truth = _truth(planned, run.own_truth)
        if planned.digest and planned.digest not in (run.digest, run.recording_digest):
            raise SourceError(
                "this is another recording than the one that was annotated",
                where=planned.source.uri,
                remedy="Open it and annotate it, or leave it out",
            )
    except BaseException:
        run.close()
        raise
    digest = digest_with_truth(plan, planned.source, run.digest, truth)
    return SearchRun(planned.source.uri, planned.held_out, run.digest, digest, run, truth)


def _truth(planned: PlannedRun, own: TruthTrees | None) -> TruthTrees:
    """Return the true trees of a run: those that were given, else those of the source with the annotations
    applied.

    Args:
        planned: The run.
        own: True trees of the source, or None.

    Raises:
        SourceError: There are no true trees.
    """
    uri = planned.source.uri
    if planned.truth is not None:
        return planned.truth.trees()
    if planned.annotations is not None:
        contents = contents_of(planned.annotations.trees())
        truth = laid_over(own, [Annotation(k, content, "", 0, 1) for k, content in enumerate(contents)])
        if truth is None:
            remedy = "Open it and annotate some in the tab Annotate, or leave it out"
            raise SourceError("no true trees are known of this run", where=uri, remedy=remedy)
        return truth
    if own is None:
        remedy = f"Give them with --truth {uri}=trees.csv"
        raise SourceError("the run brings no true trees", where=uri, remedy=remedy)
    return own


class Search:
    """A search whose trials are kept in a storage.

    Args:
        plan: The search.
        worker: Number of this process among those of the search, from 0.
        stop: Called often; the search stops at once when it returns True.

    Attributes:
        sources: URI, digest of the source and whether it is held out, by run.
        study: Study of Optuna.
        start: Scored start of the search, after `begin`.

    Raises:
        StemmapError: A run cannot be read or scored, or the storage belongs to another search.
    """

    def __init__(self, plan: Plan, *, worker: int = 0, stop: Callable[[], bool] = lambda: False) -> None:
        self.plan = plan
        self._worker, self.stop = worker, stop
        self._checked_s = 0.0
        self._known: dict[int, Trial] = {}
        self._start = plan.parameters
        check(plan.axes, self._start)
        self._storage: Any = None
        self._runs = open_runs(plan)
        try:
            self.sources = [(run.uri, run.source_digest, run.held_out) for run in self._runs]
            digests = [run.digest for run in self._runs if not run.held_out]
            self.study, self._storage = open_study(plan.storage, identity(plan, digests))
            self._study_id = self._storage.get_study_id_from_name(self.study.study_name)
            self._host = f"{socket.gethostname()} "
            self._me = f"{self._host}{os.getpid()}"
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the runs and the storage."""
        for each in self._runs:
            each.run.close()
        if self._storage is not None:
            close_storage(self._storage)

    @property
    def training(self) -> list[SearchRun]:
        """The runs that guide the search."""
        return [run for run in self._runs if not run.held_out]

    @property
    def held_out(self) -> list[SearchRun]:
        """The runs that are only scored."""
        return [run for run in self._runs if run.held_out]

    def begin(self) -> Trial:
        """Score the parameters with which the search begins, and return them as a trial. This also fills the
        caches of the runs.

        Raises:
            StemmapError: A run cannot be scored.
            StoppedError: The search was stopped.
        """
        scores: dict[bool, list[RunScore]] = {False: [], True: []}
        for run in self._runs:
            evaluation = run.evaluate(self._start, self._tick)
            check_start(run, evaluation, self._start)
            scores[run.held_out].append(score_of(evaluation))
        self.start = Trial(-1, self._start_values(), 0.0, tuple(scores[False]), tuple(scores[True]))
        self._start_pool = pool(self.start.training)
        self.start = msgspec.structs.replace(self.start, loss=self._loss(self.start.training))
        self._enqueue_start()
        return self.start

    def step(self) -> Trial | None:
        """Make the next trial and return it; None when all trials are made, or are being made by other
        processes.

        Raises:
            StoppedError: The search was stopped.
        """
        left = self._abandoned()
        if left is not None:
            return self._make(left.number, left.params)
        while _counted(self._all()) < self.plan.trials:
            trial = self.study.ask()
            self._note(trial.number, "by", self._me)
            if self._is_surplus(trial.number):  # another process began one at the same time
                self._drop(trial.number)
                continue
            self.study.sampler = self._sampler(trial.number)
            for axis in self.plan.axes:
                axis.suggest(trial)
            return self._make(trial.number, trial.params)
        return None

    @property
    def is_under_way(self) -> bool:
        """Whether another process makes a trial."""
        return any(trial.state.name == "RUNNING" for trial in self._all())

    def trials(self) -> list[Trial]:
        """Return all completed trials, by number."""
        for trial in self._all():
            if trial.number not in self._known and trial.state.name in ("COMPLETE", "PRUNED"):
                self._known[trial.number] = self._trial(trial)
        return [self._known[number] for number in sorted(self._known)]

    def best(self) -> Trial | None:
        """Return the trial with the smallest loss, the earliest of equals; None before the first."""
        return best_of(self.trials(), None)

    def with_held_out(self, trial: Trial) -> Trial:
        """Return a trial with the scores of the held-out runs, which are computed if they are missing."""
        if len(trial.held_out) == len(self.held_out):
            return trial
        scores = scores_of(self.held_out, self.parameters_of(trial), self._tick)
        return msgspec.structs.replace(trial, held_out=tuple(scores))

    def parameters_of(self, trial: Trial) -> Parameters:
        """Return all parameters of a trial.

        Raises:
            ParameterError: They contradict one another.
        """
        return self._start.replace(dict(trial.values))

    # --- one trial ---------------------------------------------------------------------------------

    def _is_surplus(self, number: int) -> bool:
        """Return whether a trial that begins exceeds the number of the plan, or is the second one with the
        values of the start.

        Numbers are given in sequence, so that of two processes only one sees the other's number before its
        own.
        """
        before = [trial for trial in self._all() if trial.number <= number]
        starts = [t.number for t in before if _FIXED in t.system_attrs and t.state.name != "FAIL"]
        return _counted(before) > self.plan.trials or number in starts[1:]

    def _drop(self, number: int) -> None:
        from optuna.trial import TrialState

        self.study.tell(number, state=TrialState.FAIL, skip_if_finished=True)

    def _make(self, number: int, params: dict[str, Any]) -> Trial:
        from optuna.trial import TrialState

        values = values_of(self.plan.axes, params)
        trial = self._same(values, number) or self._score(number, values)
        scores = {"training": trial.training, "held_out": trial.held_out}
        if not self._note(number, "scores", msgspec.to_builtins(scores)):
            return trial
        if trial.loss is None:  # counts as the worst, so that the sampler avoids such sets
            self.study.tell(number, state=TrialState.PRUNED, skip_if_finished=True)
        else:
            self.study.tell(number, trial.loss, skip_if_finished=True)
        return trial

    def _all(self) -> list[Any]:
        return list(self.study.get_trials(deepcopy=False))

    def _note(self, number: int, name: str, value: object) -> bool:
        """Store an attribute of a trial. Return False if the trial is complete, because two processes that
        take over the same trial get the same result.

        Args:
            number: Number of the trial.
            name, value: The attribute.
        """
        from optuna.exceptions import UpdateFinishedTrialError

        trial_id = self._storage.get_trial_id_from_study_id_trial_number(self._study_id, number)
        try:
            self._storage.set_trial_user_attr(trial_id, name, value)
        except UpdateFinishedTrialError:
            return False
        return True

    def _score(self, number: int, values: dict[str, Value]) -> Trial:
        try:
            parameters = self._start.replace(dict(values))
        except ParameterError:
            return Trial(number, values, None)
        training = tuple(scores_of(self.training, parameters, self._tick))
        loss, best = self._loss(training), self.best()
        trial = Trial(number, values, loss, training)
        if best is None or best.loss is None or loss < best.loss:
            return self.with_held_out(trial)
        return trial

    def _same(self, values: dict[str, Value], number: int) -> Trial | None:
        """Return a completed trial with the same values under a new number; None if there is none."""
        for trial in self.trials():
            if trial.values == values:
                return msgspec.structs.replace(trial, number=number)
        return None

    def _loss(self, training: tuple[RunScore, ...]) -> float:
        return self.plan.aim.loss(pool(training), self._start_pool)

    def _start_values(self) -> dict[str, Value]:
        flat = self._start.flat()
        return {axis.name: flat[axis.name] for axis in self.plan.axes}

    def _enqueue_start(self) -> None:
        """Make the start the first trial, if it is within the bounds."""
        values = self._start_values()
        begun = any(trial.state.name != "FAIL" for trial in self._all())
        if not begun and all(axis.holds(values[axis.name]) for axis in self.plan.axes):
            self.study.enqueue_trial(values)

    def _sampler(self, number: int) -> Any:  # noqa: ANN401 - Optuna has no types
        from optuna.samplers import TPESampler

        seed = np.random.SeedSequence((self.plan.seed, number, self._worker)).generate_state(1)[0]
        return TPESampler(seed=int(seed))

    def _abandoned(self) -> Any | None:  # noqa: ANN401
        """Return a trial whose process has ended, after this process has taken it over; None if there is
        none."""
        for trial in self._all():
            if trial.state.name != "RUNNING" or not self._is_gone(trial):
                continue
            if len(trial.params) < len(self.plan.axes):  # it ended before it had values
                self._drop(trial.number)
                continue
            if self._note(trial.number, "by", self._me):
                return trial
        return None

    def _is_gone(self, trial: Any) -> bool:  # noqa: ANN401
        by = str(trial.user_attrs.get("by", ""))
        if by.startswith(self._host):
            return by == self._me or not _lives(by.removeprefix(self._host))
        begun = trial.datetime_start
        patience = _ABANDONED_S if by else _UNNAMED_S
        return begun is not None and time.time() - begun.timestamp() > patience

    def _trial(self, trial: Any) -> Trial:  # noqa: ANN401
        kept = trial.user_attrs.get("scores", {})
        scores = {name: msgspec.convert(of, tuple[RunScore, ...]) for name, of in kept.items()}
        loss = trial.value if trial.state.name == "COMPLETE" else None
        return Trial(trial.number, values_of(self.plan.axes, trial.params), loss, **scores)

    def _tick(self) -> None:
        now = time.monotonic()
        if now - self._checked_s > _STOP_CHECK_S:
            self._checked_s = now
            if self.stop():
                raise StoppedError


def _counted(trials: list[Any]) -> int:
    """Return the number of trials of Optuna that are complete or being made."""
    return sum(trial.state.name in ("COMPLETE", "PRUNED", "RUNNING") for trial in trials)


def importances(study: Any) -> dict[str, float]:  # noqa: ANN401 - Optuna has no types
    """Return the share of the variance of the loss that each parameter explains (fANOVA, Hutter et al. 2014),
    the largest first. Empty if there are too few trials or all have the same loss.

    Args:
        study: Study of Optuna.
    """
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances

    try:
        found = get_param_importances(study, evaluator=FanovaImportanceEvaluator(seed=0))
    except (RuntimeError, ValueError):
        return {}
    return {name: float(value) for name, value in found.items() if np.isfinite(value)}


def _lives(pid: str) -> bool:
    if not pid.isdigit():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except OSError:  # the process of another user
        return True
    return True


MODULE = "app.tuning.search"
_STARTS_LIMIT = 4
_GRACE_S = 2.0
_MESSAGE_INTERVAL_S = 0.25


class SearchWorkers:
    """Child processes that make trials of the same search.

    Args:
        plan: The search; the processes share its storage.
        number: Number of processes.

    Attributes:
        lost: Number of processes that ended too early.
    """

    def __init__(self, plan: Plan, number: int) -> None:
        self._plan = plan
        self.lost = 0
        self._starts = [1] * number
        self._processes = [self._start(k) for k in range(number)]

    @property
    def pids(self) -> list[int]:
        """Process numbers of the running processes."""
        return [process.pid for process in self._processes if process.returncode is None]

    def watch(self) -> None:
        """Restart processes that ended too early, each at most `_STARTS_LIMIT` times."""
        for k, process in enumerate(self._processes):
            if process.returncode in (None, 0) or self._starts[k] >= _STARTS_LIMIT:
                continue
            process.end()
            self.lost += 1
            self._starts[k] += 1
            self._processes[k] = self._start(k)

    def close(self) -> None:
        """End all processes."""
        for process in self._processes:
            process.end(_GRACE_S)

    def _start(self, k: int) -> BlockingChildProcess:
        process = BlockingChildProcess(python_module(MODULE, "worker", str(k + 1)))
        process.send(self._plan)
        return process


def make_trials(parent: ParentConnection, worker: int, stopped: threading.Event) -> None:
    """Make trials until all are made, the search is stopped or the parent ends; the program of a child
    process.

    Args:
        parent: Connection that sends the plan.
        worker: Number of this process.
        stopped: Set when the search is stopped.
    """
    try:
        search = Search(parent.receive(Plan), worker=worker, stop=stopped.is_set)
        search.begin()
        while search.step() is not None:
            pass
    except StoppedError:
        pass
    except StemmapError as error:
        print(f"stemmap: {error}", file=sys.stderr)  # noqa: T201 - the terminal of the command shows it
        sys.exit(1)


class PageSearch:
    """The search of the page, in a child process. Its journal is in a folder that the parent deletes after
    the search; if the parent ends first, this process deletes it."""

    def __init__(self) -> None:
        self._folder = Path()

    def run(self, parent: ParentConnection) -> None:
        """Receive the plan, search, and send `SearchMessage`s."""
        plan = parent.receive(Plan)
        self._folder = Path(plan.storage).parent
        try:
            self._search(plan, parent)
        except StoppedError:
            parent.send(SearchMessage())
        except OtherSearchError as error:
            parent.send(
                SearchMessage(error=(f"this search has changed: {error.differs}", "", "Search again"))
            )
        except StemmapError as error:
            parent.send(SearchMessage(error=(error.what, error.where, error.remedy)))
        except MemoryError:
            parent.send(SearchMessage(error=("the search needs more memory than this machine has", "", "")))

    def parent_ended(self) -> None:
        """Delete the journal and end the process."""
        if self._folder.name.startswith(JOURNAL_FOLDER):
            shutil.rmtree(self._folder, ignore_errors=True)
        os._exit(1)

    def _search(self, plan: Plan, parent: ParentConnection) -> None:
        search = Search(plan, stop=lambda: parent.has_message)
        try:
            parent.send(SearchMessage(start=search.begin(), trials=tuple(search.trials())))
            until = time.monotonic() + plan.seconds if plan.seconds else float("inf")
            self._make_trials(search, parent, until)
            search.stop = lambda: False
            parent.send(SearchMessage(result=result_of(search)))
        finally:
            search.close()

    def _make_trials(self, search: Search, parent: ParentConnection, until: float) -> None:
        news: list[Trial] = []
        sent_s = 0.0
        try:
            while time.monotonic() < until and (trial := search.step()) is not None:
                news.append(trial)
                if time.monotonic() - sent_s > _MESSAGE_INTERVAL_S:
                    sent_s = time.monotonic()
                    parent.send(SearchMessage(trials=tuple(news)))
                    news = []
        except StoppedError:
            pass
        parent.send(SearchMessage(trials=tuple(news)))


def main(arguments: list[str]) -> None:
    """Run one of the two child programs.

    Args:
        arguments: "page", or "worker" and the number of the process.
    """
    if arguments[0] == "page":
        page = PageSearch()
        run_child(page.run, low_priority=True, on_close=page.parent_ended)
    stopped = threading.Event()
    worker = int(arguments[1])
    run_child(lambda parent: make_trials(parent, worker, stopped), on_close=stopped.set)


if __name__ == "__main__":
    main(sys.argv[1:])
