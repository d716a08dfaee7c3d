"""The goals of a search. A goal turns the scores of several runs into one loss; smaller is better."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import msgspec

from pipeline.errors import ParameterError
from pipeline.evaluation import Evaluation

GoalName = Literal["f1", "ta", "position", "pairs"]
GOALS: dict[GoalName, str] = {
    "f1": "F1",
    "ta": "true acceptance (TA), false trees bounded",
    "position": "position RMSE, F1 not below that of the start",
    "pairs": "mean pair error, F1 not below that of the start",
}
# Loss from which on a set breaks the bound of its goal; larger than any TA, RMSE [m] or pair error [%] of a
# set that keeps it.
_BROKEN: dict[GoalName, float] = {"f1": 1.0, "ta": 2.0, "position": 1e3, "pairs": 1e6}


class RunScore(msgspec.Struct, frozen=True):
    """Counts and errors of one run.

    Attributes:
        TA, FR: True trees that were found, and that were missed.
        FA, TR: Other objects that were mapped as trees, and that were not.
        spurious: Mapped trees where no object is known.
        position_rmse: Of the TA matched trees [m]; None without any.
        pair_error: Mean error of the distances between each two of them [%]; None with fewer than two.
    """

    TA: int
    FR: int
    FA: int
    TR: int
    spurious: int
    position_rmse: float | None
    pair_error: float | None


@dataclass(frozen=True, slots=True)
class Pooled:
    """Scores of several runs together. Each tree has the same weight, and each pair within a run.

    Attributes:
        f1: 2 TA / (2 TA + FR + FA + spurious).
        ta: TA / (TA + FR).
        false_share: (FA + spurious) / (TA + FA + spurious), the share of mapped trees that are false; 0 for
            an empty map.
        position_rmse: sqrt(sum TA_k rmse_k^2 / sum TA_k) [m].
        pair_error: Mean over all pairs [%].
    """

    f1: float
    ta: float
    false_share: float
    position_rmse: float | None
    pair_error: float | None


@dataclass(frozen=True, slots=True)
class Goal:
    """The goal of a search.

    Attributes:
        name: See `GOALS`.
        false_max: Largest share of false trees that the goal "ta" allows.
    """

    name: GoalName = "f1"
    false_max: float = 0.1

    def loss(self, pooled: Pooled, start: Pooled) -> float:
        """The value that the search minimises. A set that breaks the goal's bound is worse than every set
        that keeps it, and the more so the larger the violation; otherwise an empty map would have the
        smallest errors.

        Args:
            pooled: Scores of the set.
            start: Scores of the parameters with which the search began.
        """
        if self.name == "f1":
            return 1.0 - pooled.f1
        if self.name == "ta":
            beyond = pooled.false_share - self.false_max
            return 1.0 - pooled.ta if beyond <= 0.0 else _BROKEN["ta"] + beyond
        error = pooled.position_rmse if self.name == "position" else pooled.pair_error
        short = start.f1 - pooled.f1
        return _BROKEN[self.name] + max(short, 0.0) if error is None or short > 1e-12 else error

    def is_kept(self, loss: float) -> bool:
        """Whether a loss is that of a set that keeps the goal's bound."""
        return self.name == "f1" or loss < _BROKEN[self.name]

    def shown(self, loss: float) -> str:
        """A loss as text: the figure with its unit."""
        if not self.is_kept(loss):
            return "outside the bound"
        if self.name in ("f1", "ta"):
            return f"{self.label} {1.0 - loss:.3f}"
        return (
            f"{self.label} {100.0 * loss:.2f} cm" if self.name == "position" else f"{self.label} {loss:.3f} %"
        )

    @property
    def label(self) -> str:
        """The figure's short name."""
        return {"f1": "F1", "ta": "TA", "position": "RMSE", "pairs": "pair error"}[self.name]

    @property
    def words(self) -> str:
        """The goal as text."""
        bound = f" (at most {100.0 * self.false_max:g} % of the mapped trees)" if self.name == "ta" else ""
        return GOALS[self.name] + bound


def goal_of(name: str, false_max: float) -> Goal:
    """Return the goal of a name.

    Raises:
        ParameterError: There is no such goal, or the bound is not a share.
    """
    if name not in GOALS:
        raise ParameterError(f"there is no goal {name!r}", remedy=f"Goals: {', '.join(GOALS)}")
    if not 0.0 <= false_max <= 1.0:
        raise ParameterError(f"{false_max:g} is not a share of trees", remedy="Give a number from 0 to 1")
    return Goal(name, false_max)


def score_of(e: Evaluation) -> RunScore:
    """Return the scores that a search stores of an evaluation."""
    return RunScore(
        e.TA.count,
        e.FR.count,
        e.FA.count,
        e.TR.count,
        e.spurious,
        e.position_rmse,
        e.mean_pair_error_percent,
    )


def pool(scores: Sequence[RunScore]) -> Pooled:
    """Pool the scores of several runs, see `Pooled`."""
    ta, fr = sum(s.TA for s in scores), sum(s.FR for s in scores)
    wrong = sum(s.FA + s.spurious for s in scores)
    squares = [(s.TA, s.position_rmse**2) for s in scores if s.position_rmse is not None]
    pairs = [(s.TA * (s.TA - 1) // 2, s.pair_error) for s in scores if s.pair_error is not None]
    rms = _mean(squares)
    return Pooled(
        f1=2.0 * ta / (2.0 * ta + fr + wrong) if ta else 0.0,
        ta=ta / (ta + fr) if ta else 0.0,
        false_share=wrong / (ta + wrong) if wrong else 0.0,
        position_rmse=None if rms is None else math.sqrt(rms),
        pair_error=_mean(pairs),
    )


def _mean(weighed: list[tuple[int, float]]) -> float | None:
    whole = sum(weight for weight, _ in weighed)
    return sum(weight * value for weight, value in weighed) / whole if whole else None
