"""The search: Optuna suggests a parameter set, processes map the runs with it, and the scores are stored.

The suggestion with number n of P processes depends only on its number, the seed and the trials with numbers
below n - P + 1. The same input therefore gives the same result, and a stopped search that begins again finds
the stored results of the trials that it made.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from app.batch.summary import far_map, far_truth
from app.common.child_process import ParentConnection, run_child
from app.common.task_pool import TaskPool
from app.extensions.search.jobs import COMMAND, Job, JobResult, ResultStore, ScoringProcesses
from app.extensions.search.plan import (
    Plan,
    Trial,
    check,
    pool,
    values_of,
)
from app.extensions.search.result import SearchMessage, best_of, result_of
from app.extensions.search.scoring import prepare_run
from pipeline.config.model import Value
from pipeline.errors import ParameterError, StemmapError
from pipeline.evaluation import MapScores


def check_start(uri: str, scores: MapScores, match_distance: float) -> None:
    """Check that a run can be scored at all.

    Args:
        uri: URI of the run.
        scores: Scores of its first map.
        match_distance: Maximum distance between a tree and its ground truth [m].

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
        values: Dict from parameter names to the values of the set.
        parameters: Dict from stages to dicts from names to values, with all parameters; None if the values
            contradict one another.
        runs: Numbers of the runs on which it is scored.
        begun: Number of runs that were given to a process, the first ones of `runs`.
        scores: Dict from the number of a run to its scores.
    """

    values: dict[str, Value]
    parameters: dict[str, dict[str, Any]] | None
    runs: list[int]
    begun: int = 0
    scores: dict[int, MapScores] = field(default_factory=dict)

    def scores_of(self, runs: Sequence[int]) -> tuple[MapScores, ...]:
        """Return the scores of some runs; () unless all of them are known."""
        known = [self.scores[run] for run in runs if run in self.scores]
        return tuple(known) if len(known) == len(runs) else ()


_Tag = tuple[_Attempt, int]  # a set and the number of a run


class Search:
    """A search whose sets of parameters are scored by processes. The constructor opens every run of the
    plan, but starts no job.

    Args:
        plan: The search.
        processes: Map and score the runs; the caller closes them.

    Attributes:
        start: Scored start of the search; None before.

    Raises:
        StemmapError: A run cannot be read, or the search space has no set without contradictions.
    """

    def __init__(self, plan: Plan, processes: ScoringProcesses[_Tag]) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.plan, self._processes = plan, processes
        self._parameters = plan.parameters
        check(plan.axes, self._parameters)
        self._runs = [prepare_run(planned).run for planned in plan.runs]
        self._training = [k for k, planned in enumerate(plan.runs) if not planned.held_out]
        self._held_out = [k for k, planned in enumerate(plan.runs) if planned.held_out]
        self._trials: list[Trial] = []
        self._study = optuna.create_study(direction="minimize")
        self.start: Trial | None = None
        self._beginning = _Attempt(
            self._start_values(), self._parameters.model_dump(), list(range(len(self._runs)))
        )
        self._attempts = [self._beginning]  # sets that are not trials yet, in the order of their suggestion
        self._learned = 0

    @property
    def sources(self) -> list[tuple[str, str, bool]]:
        """URI, digest of the source and whether it is held out, by run."""
        return [
            (planned.source.uri, run.digest, planned.held_out)
            for planned, run in zip(self.plan.runs, self._runs, strict=True)
        ]

    @property
    def is_complete(self) -> bool:
        """Whether all trials are made."""
        return self.start is not None and len(self._trials) >= self.plan.trials

    def trials(self) -> list[Trial]:
        """Return all completed trials, by number, as another list."""
        return list(self._trials)

    def best(self) -> Trial | None:
        """Return the trial with the smallest loss, the earliest of equals; None before the first scored
        trial. The start is not included."""
        return best_of(self._trials, None)

    def advance(self, wait_s: float = 0.2) -> list[Trial]:
        """Give jobs to the free processes and wait for results. The parameters with which the search begins
        are scored first.

        Args:
            wait_s: Longest wait [s]. The call returns earlier with the first result, and at once if no job is
                in progress.

        Returns:
            The trials that were completed in this call, by number; the start is none of them.

        Raises:
            StemmapError: No process can be started, or a run cannot be mapped or scored.
        """
        before = len(self._trials)
        for (attempt, run), result in self._processes.advance(self._next_job, wait_s):
            self._receive(attempt, run, result)
        return self._trials[before:]

    # --- one trial ---------------------------------------------------------------------------------

    def _next_job(self, _worker: int) -> tuple[_Tag, Job] | None:
        """Return the next run to be mapped with a set, and take it from the queue; a new set is suggested if
        no known one waits. A suggested set whose values contradict one another needs no job: it becomes a
        trial without a loss in its turn, and another set is suggested. None if there is nothing to do now:
        while the last runs of the start are scored, while there is a set for each process, and when all
        trials are made or in progress."""
        attempt = next((each for each in self._attempts if each.begun < len(each.runs)), None)
        while attempt is None and self._may_suggest():
            suggested = self._suggested()
            self._attempts.append(suggested)
            if suggested.parameters is None:
                self._complete_in_order()
            else:
                attempt = suggested
        if attempt is None or attempt.parameters is None:
            return None
        run = attempt.runs[attempt.begun]
        attempt.begun += 1
        return (attempt, run), Job(self._runs[run], attempt.parameters)

    def _may_suggest(self) -> bool:
        """Return whether another set may be suggested: the start is scored, fewer sets than processes are in
        progress, and not all trials are made or in progress."""
        in_progress = len(self._attempts)
        is_left = len(self._trials) + in_progress < self.plan.trials
        return self.start is not None and is_left and in_progress < self._processes.count

    def _suggested(self) -> _Attempt:
        """Return the next set to score; one whose values contradict one another has no parameters and no
        runs."""
        values = self._suggestion()
        try:
            parameters = self._parameters.replace(dict(values))
        except ParameterError:
            return _Attempt(values, None, [])
        return _Attempt(values, parameters.model_dump(), list(self._training))

    def _suggestion(self) -> dict[str, Value]:
        """Return a dict from parameter names to the values to try next. For the first trial these are the
        values of the start, if they are within the bounds; then those that Optuna suggests. The trials on
        which they depend are first added to its study."""
        from optuna.samplers import TPESampler
        from optuna.trial import TrialState

        axes, number = self.plan.axes, len(self._trials) + len(self._attempts)
        self._learn(number - self._processes.count + 1)
        values = self._start_values()
        if not number and all(axis.holds(values[axis.name]) for axis in axes):
            return values
        key = (self.plan.seed, number)
        self._study.sampler = TPESampler(seed=int(np.random.SeedSequence(key).generate_state(1)[0]))
        trial = self._study.ask({axis.name: axis.distribution() for axis in axes})
        # Optuna learns of the set when it is scored, see `_learn`.
        self._study.tell(trial, state=TrialState.FAIL)
        return values_of(axes, trial.params)

    def _receive(self, attempt: _Attempt, run: int, result: JobResult) -> None:
        """Store the score of a run of a set, and complete the sets whose turn it is.

        Raises:
            StemmapError: The job failed, or the start cannot be scored (see `check_start`).
        """
        if result.scores is None:
            raise StemmapError(result.error)
        if attempt is self._beginning:
            uri = self.plan.runs[run].source.uri
            check_start(uri, result.scores, self._parameters.evaluation.match_distance)
        attempt.scores[run] = result.scores
        self._complete_in_order()

    def _complete_in_order(self) -> None:
        """Make trials of the sets whose runs are all scored, in the order of suggestion, up to the first set
        with a run that is not scored. The first set becomes `start`. If a set is the best so far and its
        held-out runs are not scored, they are queued and the set is not a trial yet. A set without runs,
        because its values contradict one another, becomes a trial without a loss."""
        while self._attempts and len(self._attempts[0].scores) == len(self._attempts[0].runs):
            attempt, loss = self._attempts[0], None
            training, held_out = attempt.scores_of(self._training), attempt.scores_of(self._held_out)
            if attempt is self._beginning:
                loss = self.plan.aim.loss(pool(training), pool(training))
                self.start = Trial(-1, attempt.values, loss, training, held_out)
            else:
                assert self.start is not None  # noqa: S101 - it is scored before all others
                if attempt.parameters is not None:
                    loss = self.plan.aim.loss(pool(training), pool(self.start.training))
                    best = self.best()
                    is_best = best is None or best.loss is None or loss < best.loss
                    if is_best and len(held_out) < len(self._held_out):
                        attempt.runs += self._held_out
                        return
                number = len(self._trials)
                self._trials.append(Trial(number, attempt.values, loss, training, held_out))
            self._attempts.pop(0)

    def _learn(self, until: int) -> None:
        """Add the trials with numbers below `until` to the study of Optuna, unless it has them. A trial
        without a loss is added as pruned."""
        from optuna.trial import TrialState, create_trial

        distributions = {axis.name: axis.distribution() for axis in self.plan.axes}
        for trial in self._trials[self._learned : max(until, 0)]:
            state = TrialState.PRUNED if trial.loss is None else TrialState.COMPLETE
            self._study.add_trial(
                create_trial(state=state, value=trial.loss, params=trial.values, distributions=distributions)
            )
        self._learned = max(self._learned, until)

    def _start_values(self) -> dict[str, Value]:
        """Return a dict from the name of each searched parameter to its value at the start."""
        flat = self._parameters.flat()
        return {axis.name: flat[axis.name] for axis in self.plan.axes}

    def importances(self) -> dict[str, float]:
        """Return a dict from the name of each searched parameter to the share of the variance of the loss
        that it explains (fANOVA, Hutter et al. 2014), the largest first. Shares that are not finite are
        omitted. The dict is empty if there are too few trials or all have the same loss. Suggestions after
        this call depend on all trials so far."""
        from optuna.importance import FanovaImportanceEvaluator, get_param_importances

        self._learn(len(self._trials))
        try:
            found = get_param_importances(self._study, evaluator=FanovaImportanceEvaluator(seed=0))
        except (RuntimeError, ValueError):
            return {}
        return {name: float(value) for name, value in found.items() if np.isfinite(value)}


def search_processes(plan: Plan, number: int = 1, pool: TaskPool | None = None) -> ScoringProcesses[_Tag]:
    """Return processes that score the sets of a search; each keeps all runs open. Results are stored in the
    folder `plan.kept`, without one in memory. The caller closes the processes.

    Args:
        plan: The search.
        number: Number of processes.
        pool: Where they are; None for this machine.
    """
    kept = ResultStore(Path(plan.kept) if plan.kept else None)
    return ScoringProcesses(number, (*COMMAND, "--runs", str(len(plan.runs))), kept, pool)


_MESSAGE_INTERVAL_S = 0.25


def search_for_page(parent: ParentConnection) -> None:
    """Run the program of the child process of a search: receive a `Plan`, search until a further message
    arrives, all trials are made or the time is over, and send `SearchMessage`s."""
    plan = parent.receive(Plan)
    with closing(search_processes(plan)) as processes:
        _search_for_page(Search(plan, processes), parent)


def _search_for_page(search: Search, parent: ParentConnection) -> None:
    """Advance a search until it is complete, a message arrives or its time is over. Send first the scored
    start, then the new trials, at most every `_MESSAGE_INTERVAL_S`, and last the result. If a message arrives
    before the start is scored, only an empty `SearchMessage` is sent. The time limit, 0 for none, counts from
    the scored start on. Errors of `Search.advance` pass through.

    Args:
        search: The search.
        parent: Connection to the server.
    """
    while search.start is None:
        if parent.has_message:
            parent.send(SearchMessage())
            return
        search.advance()
    parent.send(SearchMessage(start=search.start))
    sent_s = time.monotonic()
    until_s = sent_s + search.plan.seconds if search.plan.seconds else float("inf")
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
