"""The search: Optuna suggests a parameter set, workers map the runs with it, and the scores are stored.

A suggestion depends only on the trials before it, its number and the seed. A stopped search therefore
continues with the trials that it would have made, and with one worker the same input gives the same result.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from app.batch.summary import far_map, far_truth
from app.common.child_process import ParentConnection, python_module, run_child
from app.dashboard.annotations import laid_over
from app.store.records import as_truth, contents_of
from app.tuning.jobs import Job, RunWithTruth, code_digest
from app.tuning.plan import (
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
from app.tuning.result import SearchMessage, SearchStart, best_of, result_of
from app.tuning.scoring import open_run
from app.tuning.storage import open_trials
from app.tuning.workers import SCORING, Done, Lost, Processes, Workers
from pipeline.config.model import Value
from pipeline.errors import ParameterError, SourceError, StemmapError
from pipeline.evaluation import MapScores
from pipeline.types.records import TruthTrees

MOST_LOSSES = 4  # a set of parameters that loses so many workers ends the search


@dataclass(frozen=True, slots=True)
class SearchRun:
    """A run of a search with its true trees.

    Attributes:
        uri, held_out: As planned.
        digest: Digest of the source, how it is opened and its true trees.
        run: What the workers map and score.
    """

    uri: str
    held_out: bool
    digest: str
    run: RunWithTruth


def _prepared(plan: Plan, planned: PlannedRun) -> SearchRun:
    """Open a run, read its true trees, and close it again.

    Raises:
        StemmapError: It cannot be read, is another recording than the annotated one, or has no true trees.
    """
    uri = planned.source.uri
    with closing(open_run(planned.source)) as run:
        truth = _truth(planned, run.own_truth)
        if planned.digest and planned.digest not in (run.digest, run.recording_digest):
            raise SourceError(
                "this is another recording than the one that was annotated",
                where=uri,
                remedy="Open it and annotate it, or leave it out",
            )
        digest = digest_with_truth(plan, planned.source, run.digest, truth)
        return SearchRun(
            uri, planned.held_out, digest, RunWithTruth(planned.source, run.digest, contents_of(truth))
        )


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
        return as_truth(planned.truth)
    if planned.annotations is not None:
        truth = laid_over(own, planned.annotations)
        if truth is None:
            remedy = "Open it and annotate some in the tab Annotate, or leave it out"
            raise SourceError("no true trees are known of this run", where=uri, remedy=remedy)
        return truth
    if own is None:
        remedy = f"Give them with --truth {uri}=trees.csv"
        raise SourceError("the run brings no true trees", where=uri, remedy=remedy)
    return own


def check_start(uri: str, scores: MapScores, match_distance: float) -> None:
    """Check that a run can be scored at all.

    Args:
        uri: URI of the run.
        scores: Scores of its first map.
        match_distance: Largest distance between a tree and its ground truth [m].

    Raises:
        StemmapError: No true tree is near the path, or no tree of the map is near a true tree.
    """
    if not scores.TA.of:
        others = scores.TR.of > 0
        what = "the ground truth near the path has no trees" if others else far_truth(scores.reach)
        raise StemmapError(what, where=uri)
    if no_tree := far_map(scores, match_distance):
        raise StemmapError(
            f"{no_tree}, with the parameters that the search begins with",
            where=uri,
            remedy="Check that the true trees are in the frame of the map (the first pose is its origin), or "
            "begin with another --preset",
        )


@dataclass(slots=True, eq=False)
class _Attempt:
    """A set of parameters that is being scored.

    Attributes:
        values: Its values by parameter name.
        parameters: All parameters, by stage.
        waiting: Numbers of the runs that no worker has begun.
        scores: Scores by number of the run.
        losses: Number of workers that were lost with it.
    """

    values: dict[str, Value]
    parameters: dict[str, dict[str, Any]]
    waiting: deque[int]
    scores: dict[int, RunScore] = field(default_factory=dict)
    losses: int = 0

    def scores_of(self, runs: Sequence[int]) -> tuple[RunScore, ...]:
        """Return the scores of some runs; () unless all of them are known."""
        known = [self.scores[run] for run in runs if run in self.scores]
        return tuple(known) if len(known) == len(runs) else ()


class Search:
    """A search whose sets of parameters are scored by workers. The constructor opens every run of the plan
    and the storage, but starts no job.

    Args:
        plan: The search.
        workers: Map and score the runs; the caller closes them.
        known: Earlier trials, where the plan names no storage.

    Attributes:
        start: Scored start of the search; None before.
        study: Study of Optuna.
        lost: Number of workers that were lost, by reason.

    Raises:
        StemmapError: A run cannot be read, the search space has no set without contradictions, or the storage
            cannot be used or belongs to another search.
    """

    def __init__(self, plan: Plan, workers: Workers, known: Sequence[Trial] = ()) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.plan, self._workers = plan, workers
        self._parameters = plan.parameters
        check(plan.axes, self._parameters)
        self._runs = [_prepared(plan, planned) for planned in plan.runs]
        self._training = [k for k, run in enumerate(self._runs) if not run.held_out]
        self._held_out = [k for k, run in enumerate(self._runs) if run.held_out]
        digests = [self._runs[k].digest for k in self._training]
        self._trials = open_trials(plan.storage, identity(plan, digests), known)
        self.study = optuna.create_study(direction="minimize")
        self.start: Trial | None = None
        self.lost = Counter[str]()
        self._beginning = _Attempt(
            self._start_values(), self._parameters.model_dump(), deque(range(len(self._runs)))
        )
        self._attempts = [self._beginning]
        self._doing: dict[str, tuple[_Attempt, int]] = {}
        self._completed: list[Trial] = []
        self._learned = 0
        self._learn()

    def close(self) -> None:
        """Close the storage; the workers remain open."""
        self._trials.close()

    @property
    def sources(self) -> list[tuple[str, str, bool]]:
        """URI, digest of the source and whether it is held out, by run."""
        return [(run.uri, run.run.digest, run.held_out) for run in self._runs]

    @property
    def is_complete(self) -> bool:
        """Whether all trials are made."""
        return self.start is not None and len(self._trials.all) >= self.plan.trials

    def trials(self) -> list[Trial]:
        """Return all completed trials, by number."""
        return list(self._trials.all)

    def best(self) -> Trial | None:
        """Return the trial with the smallest loss, the earliest of equals; None before the first scored
        trial. The start is not included."""
        return best_of(self._trials.all, None)

    def advance(self, wait_s: float = 0.2) -> list[Trial]:
        """Give jobs to the free workers and wait for results. The parameters with which the search begins are
        scored first.

        Args:
            wait_s: Longest wait [s]. The call returns earlier with the first result, and at once if no job is
                in progress.

        Returns:
            The trials that were completed in this call, with those that need no mapping (repeated or
                contradicting values).

        Raises:
            StemmapError: A run cannot be mapped or scored, one set lost `MOST_LOSSES` workers, or the trials
                cannot be stored.
        """
        self._completed = []
        for worker in self._workers.free():
            job = self._next_job()
            if job is None:
                break
            self._doing[worker] = job
            run = self._runs[job[1]].run
            self._workers.give(worker, Job(run, job[0].parameters, code_digest()))
        if self._doing:
            for event in self._workers.events(wait_s):
                self._receive(event)
        return self._completed

    # --- one trial ---------------------------------------------------------------------------------

    def _next_job(self) -> tuple[_Attempt, int] | None:
        """Return a set and the number of a run that are to be scored, and take them from the queue; a new set
        is suggested if no known one waits. None if there is nothing to do now: before the start is scored,
        and when all trials are made or in progress."""
        for attempt in self._attempts:
            if attempt.waiting:
                return attempt, attempt.waiting.popleft()
        if self.start is None:
            return None
        self._trials.refresh()
        self._learn()
        while len(self._trials.all) + len(self._attempts) < self.plan.trials:
            suggested = self._suggested()
            if suggested is not None:
                self._attempts.append(suggested)
                return suggested, suggested.waiting.popleft()
        return None

    def _suggested(self) -> _Attempt | None:
        """Return the next set to score. None for a set that needs no scoring: one whose values equal an
        earlier trial, or contradict one another. Such a set is stored as a trial at once."""
        values = self._suggestion()
        known = next((trial for trial in self._trials.all if trial.values == values), None)
        if known is not None:
            self._complete(known)
            return None
        try:
            parameters = self._parameters.replace(dict(values))
        except ParameterError:
            self._complete(Trial(-1, values, None))
            return None
        return _Attempt(values, parameters.model_dump(), deque(self._training))

    def _suggestion(self) -> dict[str, Value]:
        """Return the values to try next: as the first of all (only on the first machine) those of the start,
        if they are within the bounds; then those that Optuna suggests."""
        from optuna.samplers import TPESampler
        from optuna.trial import TrialState

        axes, number = self.plan.axes, len(self._trials.all) + len(self._attempts)
        values = self._start_values()
        if not number and not self._trials.slot and all(axis.holds(values[axis.name]) for axis in axes):
            return values
        key = (self.plan.seed, number, self._trials.slot)
        self.study.sampler = TPESampler(seed=int(np.random.SeedSequence(key).generate_state(1)[0]))
        trial = self.study.ask({axis.name: axis.distribution() for axis in axes})
        # Optuna learns of the set when it is scored, see `_learn`.
        self.study.tell(trial, state=TrialState.FAIL)
        return values_of(axes, trial.params)

    def _receive(self, event: Done | Lost) -> None:
        """Store the score of a run of a set, or queue the run again after a lost worker.

        Raises:
            StemmapError: The job failed, the start cannot be scored (see `check_start`), or one set lost
                `MOST_LOSSES` workers.
        """
        attempt, run = self._doing.pop(event.worker)
        if isinstance(event, Lost):
            self.lost[event.reason] += 1
            attempt.losses += 1
            if attempt.losses >= MOST_LOSSES:
                raise StemmapError(f"{MOST_LOSSES} processes were lost with one set: {event.reason}")
            attempt.waiting.appendleft(run)
            return
        scores = event.answer.scores
        if scores is None:
            raise StemmapError(event.answer.error)
        if attempt is self._beginning:
            check_start(self._runs[run].uri, scores, self._parameters.evaluation.match_distance)
        attempt.scores[run] = score_of(scores)
        self._finish(attempt)

    def _finish(self, attempt: _Attempt) -> None:
        """Complete a set if all its runs are scored; otherwise do nothing. If it is the best so far and has
        held-out runs without scores, these are queued first. The first set becomes `start`."""
        if attempt.waiting or any(other is attempt for other, _ in self._doing.values()):
            return
        training, held_out = attempt.scores_of(self._training), attempt.scores_of(self._held_out)
        if attempt is self._beginning:
            loss = self.plan.aim.loss(pool(training), pool(training))
            self.start = Trial(-1, attempt.values, loss, training, held_out)
        else:
            assert self.start is not None  # noqa: S101 - it is scored before all others
            loss, best = self.plan.aim.loss(pool(training), pool(self.start.training)), self.best()
            is_best = best is None or best.loss is None or loss < best.loss
            if is_best and len(held_out) < len(self._held_out):
                attempt.waiting.extend(self._held_out)
                return
            self._complete(Trial(-1, attempt.values, loss, training, held_out))
        self._attempts.remove(attempt)

    def _complete(self, trial: Trial) -> None:
        """Store a trial, unless the search has all its trials, and let Optuna learn from it."""
        added = self._trials.add(trial, self.plan.trials)
        if added is not None:
            self._completed.append(added)
        self._learn()

    def _learn(self) -> None:
        """Add the trials to Optuna's study that it does not have yet. Contradicting sets count as the worst,
        so that the sampler avoids them."""
        from optuna.trial import TrialState, create_trial

        distributions = {axis.name: axis.distribution() for axis in self.plan.axes}
        for trial in self._trials.all[self._learned :]:
            state = TrialState.PRUNED if trial.loss is None else TrialState.COMPLETE
            self.study.add_trial(
                create_trial(state=state, value=trial.loss, params=trial.values, distributions=distributions)
            )
        self._learned = len(self._trials.all)

    def _start_values(self) -> dict[str, Value]:
        """Return the values of the searched parameters at the start, by name."""
        flat = self._parameters.flat()
        return {axis.name: flat[axis.name] for axis in self.plan.axes}


def importances(study: Any) -> dict[str, float]:  # noqa: ANN401 - Optuna has no types
    """Return the share of the variance of the loss that each parameter explains (fANOVA, Hutter et al. 2014),
    by name, the largest first. Shares that are not finite are omitted. Empty if there are too few trials or
    all have the same loss.

    Args:
        study: Study of Optuna.
    """
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances

    try:
        found = get_param_importances(study, evaluator=FanovaImportanceEvaluator(seed=0))
    except (RuntimeError, ValueError):
        return {}
    return {name: float(value) for name, value in found.items() if np.isfinite(value)}


def search_processes(plan: Plan, number: int = 1) -> Processes:
    """Return processes that score the sets of a search; each keeps all runs open. The caller closes them.

    Args:
        plan: The search.
        number: Number of processes.
    """
    return Processes(number, python_module(SCORING, "--runs", str(len(plan.runs))))


_MESSAGE_INTERVAL_S = 0.25


def search_for_page(parent: ParentConnection) -> None:
    """Receive a `SearchStart`, search until a further message arrives, all trials are made or the time is
    over, and send `SearchMessage`s; the program of the child process of the page. Errors are sent as the last
    message, not raised."""
    begin = parent.receive(SearchStart)
    try:
        with (
            closing(search_processes(begin.plan)) as workers,
            closing(Search(begin.plan, workers, begin.trials)) as search,
        ):
            _search_for_page(search, begin, parent)
    except StemmapError as error:
        parent.send(SearchMessage(error=(error.what, error.where, error.remedy)))
    except MemoryError:
        parent.send(SearchMessage(error=("the search needs more memory than this machine has", "", "")))


def _search_for_page(search: Search, begin: SearchStart, parent: ParentConnection) -> None:
    """Advance a search and send its progress, at most every 0.25 s, and its result. If a message arrives
    before the start is scored, an empty `SearchMessage` is sent and there is no result. The time limit counts
    from the scored start on.

    Args:
        search: The search.
        begin: Its request, with the earlier trials and the time limit.
        parent: Connection to the server.
    """
    while search.start is None:
        if parent.has_message:
            parent.send(SearchMessage())
            return
        search.advance()
    parent.send(SearchMessage(start=search.start, trials=begin.trials))
    sent_s = time.monotonic()
    until_s = sent_s + begin.plan.seconds if begin.plan.seconds else float("inf")
    news: list[Trial] = []
    while not (parent.has_message or search.is_complete) and time.monotonic() < until_s:
        news += search.advance()
        if news and time.monotonic() > sent_s + _MESSAGE_INTERVAL_S:
            sent_s = time.monotonic()
            parent.send(SearchMessage(trials=tuple(news)))
            news = []
    parent.send(SearchMessage(trials=tuple(news)))
    parent.send(SearchMessage(result=result_of(search)))


if __name__ == "__main__":
    run_child(search_for_page, low_priority=True)
