"""The search: Optuna suggests a parameter set, processes map the runs with it, and the scores are stored.

A suggestion depends only on the trials before it, its number and the seed. A stopped search therefore
continues with the trials that it would have made, and with one process the same input gives the same result.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from app.batch.summary import far_map, far_truth
from app.common.child_process import ParentConnection, run_child
from app.tuning.jobs import Job, JobResult
from app.tuning.plan import (
    Plan,
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
from app.tuning.scoring import prepare_run
from app.tuning.trials import Journal, Trials
from app.tuning.workers import COMMAND, ScoringProcesses
from pipeline.config.model import Value
from pipeline.errors import ParameterError, StemmapError
from pipeline.evaluation import MapScores


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
        runs: Numbers of the runs on which it is scored.
        begun: How many of these were given to a process.
        scores: Scores by number of the run.
    """

    values: dict[str, Value]
    parameters: dict[str, dict[str, Any]]
    runs: list[int]
    begun: int = 0
    scores: dict[int, RunScore] = field(default_factory=dict)

    def scores_of(self, runs: Sequence[int]) -> tuple[RunScore, ...]:
        """Return the scores of some runs; () unless all of them are known."""
        known = [self.scores[run] for run in runs if run in self.scores]
        return tuple(known) if len(known) == len(runs) else ()


_Tag = tuple[_Attempt, int]  # a set and the number of a run


class Search:
    """A search whose sets of parameters are scored by processes. The constructor opens every run of the plan
    and the journal, but starts no job.

    Args:
        plan: The search.
        processes: Map and score the runs; the caller closes them.
        known: Earlier trials, where the plan has no journal.

    Attributes:
        start: Scored start of the search; None before.
        study: Study of Optuna.

    Raises:
        StemmapError: A run cannot be read, the search space has no set without contradictions, or the journal
            cannot be used or belongs to another search.
    """

    def __init__(self, plan: Plan, processes: ScoringProcesses[_Tag], known: Sequence[Trial] = ()) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.plan, self._processes = plan, processes
        self._parameters = plan.parameters
        check(plan.axes, self._parameters)
        self._runs = [prepare_run(planned).run for planned in plan.runs]
        self._training = [k for k, planned in enumerate(plan.runs) if not planned.held_out]
        self._held_out = [k for k, planned in enumerate(plan.runs) if planned.held_out]
        digests = [digest_with_truth(plan, self._runs[k]) for k in self._training]
        self._trials = Journal(Path(plan.journal), identity(plan, digests)) if plan.journal else Trials(known)
        self.study = optuna.create_study(direction="minimize")
        self.start: Trial | None = None
        self._beginning = _Attempt(
            self._start_values(), self._parameters.model_dump(), list(range(len(self._runs)))
        )
        self._attempts = [self._beginning]
        self._completed: list[Trial] = []
        self._learned = 0
        self._learn()

    def close(self) -> None:
        """Close the journal; the processes remain open."""
        self._trials.close()

    @property
    def sources(self) -> list[tuple[str, str, bool]]:
        """URI, digest of the source and whether it is held out, by run."""
        return [
            (planned.source.uri, run.digest, planned.held_out)
            for planned, run in zip(self.plan.runs, self._runs, strict=True)
        ]

    @property
    def lost(self) -> Counter[str]:
        """Number of processes that ended during a job, by reason."""
        return self._processes.lost

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
        """Give jobs to the free processes and wait for results. The parameters with which the search begins
        are scored first.

        Args:
            wait_s: Longest wait [s]. The call returns earlier with the first result, and at once if no job is
                in progress.

        Returns:
            The trials that were completed in this call, with those that need no mapping (repeated or
                contradicting values).

        Raises:
            StemmapError: A run cannot be mapped or scored, or the trials cannot be stored.
        """
        self._completed = []
        for (attempt, run), result in self._processes.advance(self._next_job, wait_s):
            self._receive(attempt, run, result)
        return self._completed

    # --- one trial ---------------------------------------------------------------------------------

    def _next_job(self, _worker: int) -> tuple[_Tag, Job] | None:
        """Return the next run to be mapped with a set, and take it from the queue; a new set is suggested if
        no known one waits. None if there is nothing to do now: before the start is scored, and when all
        trials are made or in progress."""
        attempt = next((each for each in self._attempts if each.begun < len(each.runs)), None)
        if attempt is None and self.start is not None:
            while attempt is None and len(self._trials.all) + len(self._attempts) < self.plan.trials:
                attempt = self._suggested()
            if attempt is not None:
                self._attempts.append(attempt)
        if attempt is None:
            return None
        run = attempt.runs[attempt.begun]
        attempt.begun += 1
        return (attempt, run), Job(self._runs[run], attempt.parameters)

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
        return _Attempt(values, parameters.model_dump(), list(self._training))

    def _suggestion(self) -> dict[str, Value]:
        """Return the values to try next: as the first of all those of the start, if they are within the
        bounds; then those that Optuna suggests."""
        from optuna.samplers import TPESampler
        from optuna.trial import TrialState

        axes, number = self.plan.axes, len(self._trials.all) + len(self._attempts)
        values = self._start_values()
        if not number and all(axis.holds(values[axis.name]) for axis in axes):
            return values
        key = (self.plan.seed, number, 0)  # the 0 keeps the suggestions of earlier versions
        self.study.sampler = TPESampler(seed=int(np.random.SeedSequence(key).generate_state(1)[0]))
        trial = self.study.ask({axis.name: axis.distribution() for axis in axes})
        # Optuna learns of the set when it is scored, see `_learn`.
        self.study.tell(trial, state=TrialState.FAIL)
        return values_of(axes, trial.params)

    def _receive(self, attempt: _Attempt, run: int, result: JobResult) -> None:
        """Store the score of a run of a set. When all its runs are scored, the set is complete, or becomes
        `start`. If it is the best so far and has held-out runs without scores, these are queued first.

        Raises:
            StemmapError: The job failed, or the start cannot be scored (see `check_start`).
        """
        if result.scores is None:
            raise StemmapError(result.error)
        if attempt is self._beginning:
            uri = self.plan.runs[run].source.uri
            check_start(uri, result.scores, self._parameters.evaluation.match_distance)
        attempt.scores[run] = score_of(result.scores)
        if len(attempt.scores) < len(attempt.runs):
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
                attempt.runs += self._held_out
                return
            self._complete(Trial(-1, attempt.values, loss, training, held_out))
        self._attempts.remove(attempt)

    def _complete(self, trial: Trial) -> None:
        """Store a trial, and let Optuna learn from it."""
        self._completed.append(self._trials.add(trial))
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


def search_processes(plan: Plan, number: int = 1) -> ScoringProcesses[_Tag]:
    """Return processes that score the sets of a search; each keeps all runs open. The caller closes them.

    Args:
        plan: The search.
        number: Number of processes.
    """
    return ScoringProcesses(number, (*COMMAND, "--runs", str(len(plan.runs))))


_MESSAGE_INTERVAL_S = 0.25


def search_for_page(parent: ParentConnection) -> None:
    """Receive a `SearchStart`, search until a further message arrives, all trials are made or the time is
    over, and send `SearchMessage`s; the program of the child process of the page. Errors are sent as the last
    message, not raised."""
    begin = parent.receive(SearchStart)
    try:
        with (
            closing(search_processes(begin.plan)) as processes,
            closing(Search(begin.plan, processes, begin.trials)) as search,
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
