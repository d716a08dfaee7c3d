"""The search itself, in one process: asks Optuna for a set, maps the runs with it, tells what came of it.

What a trial tries hangs on the trials before it, its number and the seed alone. So a search that was stopped
and goes on makes the trials that it would have made, and with one worker the same input gives the same.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from app.tuning.goal import RunScore, pool, score_of
from app.tuning.plan import Plan, identity
from app.tuning.runs import ScoredRun, check_start, open_runs, scores_of
from app.tuning.space import check, values_of
from app.tuning.storage import close_storage, open_study
from app.tuning.trial import Trial
from pipeline.config import Parameters
from pipeline.config.model import Value
from pipeline.errors import ParameterError

_ABANDONED_S = 1800.0  # after which a trial of another machine that tells nothing is made again
_UNNAMED_S = 60.0  # the same, of one whose process ended before it said which it was
_LOOK_EVERY_S = 0.2
_FIXED = "fixed_params"  # Optuna's attribute of a trial whose values were told beforehand


class StoppedError(Exception):
    """Somebody asked the search to stop, in the middle of a trial, which is made again when it goes on."""


class Search:
    """A search of which the trials stand in a storage.

    Args:
        plan: What is searched for.
        worker: Number of this process among those of the plan, from 0 on.
        stop: Asked often; True ends the search at once.

    Raises:
        StemmapError: A run cannot be read or judged, or the storage is not of this search.
    """

    def __init__(self, plan: Plan, *, worker: int = 0, stop: Callable[[], bool] = lambda: False) -> None:
        self.plan = plan
        self._worker, self.stop = worker, stop
        self._looked_s = 0.0
        self._known: dict[int, Trial] = {}
        self._start = plan.parameters
        check(plan.axes, self._start)
        self._storage: Any = None
        self._runs = open_runs(plan.runs, plan.seed, plan.odometry)
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
        """Let go of the runs and of the storage."""
        for run in self._runs:
            run.close()
        if self._storage is not None:
            close_storage(self._storage)

    @property
    def training(self) -> list[ScoredRun]:
        """The runs that are searched over."""
        return [run for run in self._runs if not run.held_out]

    @property
    def held_out(self) -> list[ScoredRun]:
        """The runs that are only scored."""
        return [run for run in self._runs if run.held_out]

    def begin(self) -> Trial:
        """Score the parameters to begin with; what the scans show is kept by that.

        Raises:
            StemmapError: A run cannot be judged.
            StoppedError: It was asked to stop.
        """
        scores: dict[bool, list[RunScore]] = {False: [], True: []}
        for run in self._runs:
            evaluation = run.evaluate(self._start, self._tick)
            check_start(run, evaluation, self._start)
            scores[run.held_out].append(score_of(evaluation))
        self.start = Trial(-1, self._own_values(), 0.0, tuple(scores[False]), tuple(scores[True]))
        self._start_pool = pool(self.start.training)
        self.start = msgspec.structs.replace(self.start, loss=self._loss(self.start.training))
        self._enqueue_start()
        return self.start

    def step(self) -> Trial | None:
        """Make the next trial; None when all are made or are being made elsewhere.

        Raises:
            StoppedError: It was asked to stop. The trial is made again when the search goes on.
        """
        left = self._abandoned()
        if left is not None:
            return self._make(left.number, left.params)
        while _counted(self._all()) < self.plan.trials:
            asked = self.study.ask()
            self._note(asked.number, "by", self._me)
            if self._is_too_much(asked.number):  # another process asked at the same time
                self._drop(asked.number)
                continue
            self.study.sampler = self._sampler(asked.number)
            for axis in self.plan.axes:
                axis.suggest(asked)
            return self._make(asked.number, asked.params)
        return None

    @property
    def is_under_way(self) -> bool:
        """Whether a trial is being made by another process."""
        return any(trial.state.name == "RUNNING" for trial in self._all())

    def trials(self) -> list[Trial]:
        """All that were made so far."""
        for trial in self._all():
            if trial.number not in self._known and trial.state.name in ("COMPLETE", "PRUNED"):
                self._known[trial.number] = self._told(trial)
        return [self._known[number] for number in sorted(self._known)]

    def best(self) -> Trial | None:
        """The best one so far, the earliest of equals."""
        made = [trial for trial in self.trials() if trial.loss is not None]
        return min(made, key=lambda trial: (trial.loss, trial.number), default=None)

    def with_held_out(self, trial: Trial) -> Trial:
        """A trial with the scores of the held-out runs, which are made where they are missing."""
        if len(trial.held_out) == len(self.held_out):
            return trial
        scores = scores_of(self.held_out, self.parameters_of(trial), self._tick)
        return msgspec.structs.replace(trial, held_out=tuple(scores))

    def parameters_of(self, trial: Trial) -> Parameters:
        """All parameters of a trial.

        Raises:
            ParameterError: They contradict one another.
        """
        return self._start.replace(dict(trial.values))

    # --- one trial ---------------------------------------------------------------------------------

    def _is_too_much(self, number: int) -> bool:
        """Whether a trial that begins is one more than the plan has, or the second that tries the start:
        numbers are given one after the other, so that of two processes one alone sees the other's before its
        own."""
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
        if trial.loss is None:  # counts as worse than all, so that the sampler leaves such sets
            self.study.tell(number, state=TrialState.PRUNED, skip_if_finished=True)
        else:
            self.study.tell(number, trial.loss, skip_if_finished=True)
        return trial

    def _all(self) -> list[Any]:
        return list(self.study.get_trials(deepcopy=False))

    def _note(self, number: int, name: str, value: object) -> bool:
        """Write it down; False where the trial is made already: two processes that take over one make the
        same of it."""
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
        """A trial that tried the very same, with another number."""
        for trial in self.trials():
            if trial.values == values:
                return msgspec.structs.replace(trial, number=number)
        return None

    def _loss(self, training: tuple[RunScore, ...]) -> float:
        return self.plan.aim.loss(pool(training), self._start_pool)

    def _own_values(self) -> dict[str, Value]:
        flat = self._start.flat()
        return {axis.name: flat[axis.name] for axis in self.plan.axes}

    def _enqueue_start(self) -> None:
        """Try what the search begins with first, where it lies within the bounds."""
        values = self._own_values()
        begun = any(trial.state.name != "FAIL" for trial in self._all())
        if not begun and all(axis.holds(values[axis.name]) for axis in self.plan.axes):
            self.study.enqueue_trial(values)

    def _sampler(self, number: int) -> Any:  # noqa: ANN401 - Optuna has no types
        from optuna.samplers import TPESampler

        seed = np.random.SeedSequence((self.plan.seed, number, self._worker)).generate_state(1)[0]
        return TPESampler(seed=int(seed))

    def _abandoned(self) -> Any | None:  # noqa: ANN401
        """A trial whose process is gone, now taken over."""
        for trial in self._all():
            if trial.state.name != "RUNNING" or not self._is_gone(trial):
                continue
            if len(trial.params) < len(self.plan.axes):  # it ended before it knew what to try
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

    def _told(self, trial: Any) -> Trial:  # noqa: ANN401
        kept = trial.user_attrs.get("scores", {})
        scores = {name: msgspec.convert(of, tuple[RunScore, ...]) for name, of in kept.items()}
        loss = trial.value if trial.state.name == "COMPLETE" else None
        return Trial(trial.number, values_of(self.plan.axes, trial.params), loss, **scores)

    def _tick(self) -> None:
        now = time.monotonic()
        if now - self._looked_s > _LOOK_EVERY_S:
            self._looked_s = now
            if self.stop():
                raise StoppedError


def _counted(trials: list[Any]) -> int:
    """How many are made or being made."""
    return sum(trial.state.name in ("COMPLETE", "PRUNED", "RUNNING") for trial in trials)


def importances(study: Any) -> dict[str, float]:  # noqa: ANN401 - Optuna has no types
    """How much of the loss's variance each parameter explains (fANOVA, Hutter et al. 2014), largest first;
    empty where the trials are too few or all alike."""
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
    except OSError:  # it is somebody else's
        return True
    return True
