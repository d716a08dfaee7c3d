"""The records of a search: its goal, the parameters that it varies, its runs and its trials."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import msgspec

from app.extensions.search.grid import checked_value, grid_axis, spec_of
from app.sources.request import SourceRequest
from app.store.records import Content
from pipeline.config import FieldSpec, Parameters
from pipeline.config.model import Value, validated, value_text
from pipeline.errors import ParameterError
from pipeline.evaluation import MapScores

# --- goal -------------------------------------------------------------------------------------------

GoalName = Literal["f1", "ta", "position", "pairs"]


@dataclass(frozen=True, slots=True)
class GoalDeclaration:
    """Texts of a goal, and the loss that separates the sets that break its bound.

    Attributes:
        words: Description.
        label, unit: Short name of the score and its unit; the unit is empty for F1 and TA.
        broken: Loss from which on a set breaks the bound of the goal; larger than any TA, RMSE [m] or pair
            error [%] of a set that keeps it. Every set keeps that of "f1".
    """

    words: str
    label: str
    unit: str
    broken: float


GOALS: dict[GoalName, GoalDeclaration] = {
    "f1": GoalDeclaration("F1", "F1", "", math.inf),
    "ta": GoalDeclaration("true acceptance (TA), false trees bounded", "TA", "", 2.0),
    "position": GoalDeclaration("position RMSE, F1 not below that of the start", "RMSE", "cm", 1e3),
    "pairs": GoalDeclaration("mean pair error, F1 not below that of the start", "pair error", "%", 1e6),
}


@dataclass(frozen=True, slots=True)
class Pooled:
    """Scores of several runs together. Each tree has the same weight, and each pair within a run.

    Attributes:
        f1: 2 TA / (2 TA + FR + FA + spurious).
        ta: TA / (TA + FR).
        false_share: (FA + spurious) / (TA + FA + spurious), the share of mapped trees that are false; 0 for
            an empty map.
        position_rmse_m: sqrt(sum TA_k rmse_k^2 / sum TA_k) [m].
        mean_pair_error_percent: Mean over all pairs [%].
    """

    f1: float
    ta: float
    false_share: float
    position_rmse_m: float | None
    mean_pair_error_percent: float | None


@dataclass(frozen=True, slots=True)
class Goal:
    """The goal of a search.

    Attributes:
        name: See `GOALS`.
        false_max: Maximum share of false trees that the goal "ta" allows.
    """

    name: GoalName = "f1"
    false_max: float = 0.1

    def loss(self, pooled: Pooled, start: Pooled) -> float:
        """Return the loss that the search minimises: 1 - F1 for "f1", 1 - TA for "ta", else the error.

        A set that violates the bound of the goal has a larger loss than every set that satisfies it, and the
        loss grows with the violation. Without the bound an empty map would have the smallest errors. For
        "position" and "pairs" the loss is the error itself ([m], [%]); a set whose error is unknown, or whose
        F1 is below that of the start, violates the bound.

        Args:
            pooled: Scores of the set.
            start: Scores of the parameters with which the search begins; not used by "f1" and "ta".
        """
        if self.name == "f1":
            return 1.0 - pooled.f1
        if self.name == "ta":
            beyond = pooled.false_share - self.false_max
            return 1.0 - pooled.ta if beyond <= 0.0 else self.declaration.broken + beyond
        error = pooled.position_rmse_m if self.name == "position" else pooled.mean_pair_error_percent
        short = start.f1 - pooled.f1
        return self.declaration.broken + max(short, 0.0) if error is None or short > 1e-12 else error

    def is_kept(self, loss: float) -> bool:
        """Return whether a loss is that of a set that satisfies the bound of the goal; True for "f1"."""
        return loss < self.declaration.broken

    def figure(self, loss: float) -> float:
        """Return the score, in the unit of the goal, of a loss that satisfies the bound: 1 - loss for "f1"
        and "ta", cm for "position", % for "pairs". The result has no meaning for other losses, see
        `is_kept`."""
        if self.name in ("f1", "ta"):
            return 1.0 - loss
        return 100.0 * loss if self.name == "position" else loss

    def figure_of(self, pooled: Pooled) -> float | None:
        """Return the score, in the unit of the goal, from pooled scores; None if it is unknown."""
        if self.name in ("f1", "ta"):
            return pooled.f1 if self.name == "f1" else pooled.ta
        error = pooled.position_rmse_m if self.name == "position" else pooled.mean_pair_error_percent
        return None if error is None else self.figure(error)

    def shown(self, loss: float) -> str:
        """Return a loss as text, for example "RMSE 3.20 cm" or "F1 0.912"; "outside the bound" if the goal
        does not accept it."""
        if not self.is_kept(loss):
            return "outside the bound"
        digits = 2 if self.name == "position" else 3
        return f"{self.declaration.label} {self.figure(loss):.{digits}f} {self.declaration.unit}".rstrip()

    @property
    def declaration(self) -> GoalDeclaration:
        """How the goal is shown."""
        return GOALS[self.name]

    @property
    def words(self) -> str:
        """Description of the goal; for "ta" with its bound on false trees [%]."""
        bound = f" (at most {100.0 * self.false_max:g} % of the mapped trees)" if self.name == "ta" else ""
        return self.declaration.words + bound


def pool(scores: Sequence[MapScores]) -> Pooled:
    """Return the scores of several runs together, see `Pooled`. Without scores, f1, ta and false_share are 0
    and the errors are None."""
    ta, fr = sum(s.TA.count for s in scores), sum(s.FR.count for s in scores)
    wrong = sum(s.FA.count + s.spurious for s in scores)
    squares = [(s.TA.count, s.position_rmse**2) for s in scores if s.position_rmse is not None]
    pairs = [
        (s.TA.count * (s.TA.count - 1) // 2, s.mean_pair_error_percent)
        for s in scores
        if s.mean_pair_error_percent is not None
    ]
    rms = _mean(squares)
    return Pooled(
        f1=2.0 * ta / (2.0 * ta + fr + wrong) if ta else 0.0,
        ta=ta / (ta + fr) if ta else 0.0,
        false_share=wrong / (ta + wrong) if wrong else 0.0,
        position_rmse_m=None if rms is None else math.sqrt(rms),
        mean_pair_error_percent=_mean(pairs),
    )


def _mean(weighed: list[tuple[int, float]]) -> float | None:
    """Return the weighted mean of (weight, value) pairs; None if the sum of the weights is 0."""
    whole = sum(weight for weight, _ in weighed)
    return sum(weight * value for weight, value in weighed) / whole if whole else None


# --- search space -----------------------------------------------------------------------------------

# The parameters with the largest effect on which clusters and columns become trees, within plausible bounds.
SENSIBLE = (
    "detection.e_max=10..200",
    "detection.cylindrical_stddev_thresh=0.02..0.2",
    "detection.radius_min=0..0.1",
    "detection.height_extent_min=0.1..1.2",
    "detection.arc_min=0..120",
    "classification.tree_share=0.1..0.8",
    "tracking.hits_to_confirm=1..10",
    "tracking.proximity_radius=0.2..1",
)
_NO_PART_OF_THE_MAP = {
    "evaluation": "decides how a map is scored, not how it is made",
    "obstacles": "does not change the map",
}
_LOG_FROM = 100.0  # a range whose ends differ by more than this factor is searched by its logarithm
_DIGITS = 4  # significant digits of a value, so that the file stays readable
_CORNERS = 4096


class SearchAxis(msgspec.Struct, frozen=True):
    """A parameter that a search varies.

    Attributes:
        name: Dotted name.
        kind: Kind of its values; a switch is a choice.
        low, high: Bounds of a number.
        choices: Values of a choice.
    """

    name: str
    kind: Literal["float", "int", "choice"]
    low: float = 0.0
    high: float = 0.0
    choices: tuple[str | bool, ...] = ()

    def distribution(self) -> Any:  # noqa: ANN401 - Optuna has no types
        """Return the distribution of Optuna from which a value is suggested. The scale is logarithmic if the
        lower bound is above 0 and the upper bound is at least 100 times as large."""
        from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

        log = self.low > 0.0 and self.high >= _LOG_FROM * self.low
        if self.kind == "choice":
            return CategoricalDistribution(self.choices)
        if self.kind == "int":
            return IntDistribution(int(self.low), int(self.high), log=log)
        return FloatDistribution(self.low, self.high, log=log)

    def value_of(self, suggested: Any) -> Value:  # noqa: ANN401
        """Return the parameter value for a value of Optuna.

        A number of kind "float" is rounded to `_DIGITS` significant digits and clipped to the bounds. Kind
        "int" is truncated to int without a check of the bounds. A choice is returned as it is, without a
        check.
        """
        if self.kind == "choice":
            return suggested if isinstance(suggested, bool) else str(suggested)
        if self.kind == "int":
            return int(suggested)
        return min(max(float(f"{suggested:.{_DIGITS}g}"), self.low), self.high)

    def holds(self, value: Value) -> bool:
        """Return whether a value is within the bounds, ends included. A choice must also have the same type;
        text is never within the bounds of a number."""
        if self.kind == "choice":
            return any(type(c) is type(value) and c == value for c in self.choices)
        return not isinstance(value, str) and self.low <= value <= self.high

    @property
    def words(self) -> str:
        """The axis in the syntax of `--over`, for example "clustering.eps=0.1..0.4"."""
        if self.kind == "choice":
            return f"{self.name}={','.join(value_text(c) for c in self.choices)}"
        return f"{self.name}={self.low:g}..{self.high:g}"


def axes_of(texts: Sequence[str]) -> tuple[SearchAxis, ...]:
    """Return the axes of a search, in the order of `texts`.

    Args:
        texts: Strings `NAME`, `NAME=LOW..HIGH` or `NAME=A,B`; for `NAME` alone, the bounds of the declaration
            are used.

    Raises:
        ParameterError: A name is unknown or given twice, belongs to a stage that does not change the map, or
            bounds or choices contradict the declaration.
    """
    axes = tuple(_axis(text) for text in texts)
    names = [axis.name for axis in axes]
    for name in names:
        if names.count(name) > 1:
            raise ParameterError(f"{name} is given twice", remedy="Name it once")
    return axes


def check(axes: Iterable[SearchAxis], start: Parameters) -> None:
    """Check that the search space contains a set without contradictions.

    Only the corners of the space are tried. A space with more than `_CORNERS` corners is accepted without a
    check, because each trial is checked anyway.

    Args:
        axes: The search space.
        start: Values of all other parameters.

    Raises:
        ParameterError: All corners of the space contradict themselves; the message has the first
            contradiction.
    """
    ends = [[(axis.name, value) for value in _ends(axis)] for axis in axes]
    refusal: ParameterError | None = None
    if math.prod(len(values) for values in ends) > _CORNERS:
        return  # each trial is checked anyway
    for corner in product(*ends):
        try:
            start.replace(dict(corner))
        except ParameterError as error:
            refusal = refusal or error
        else:
            return
    if refusal is not None:
        raise ParameterError(
            f"all sets within these bounds contradict themselves: {refusal.what}",
            remedy="Widen the bounds, or set the other value with --set",
        )


def values_of(axes: Iterable[SearchAxis], suggested: Mapping[str, Any]) -> dict[str, Value]:
    """Return a dict from the name of each axis to its value in a trial, see `SearchAxis.value_of`.

    Args:
        axes: The search space.
        suggested: Dict from the name of each axis to the value of Optuna.
    """
    return {axis.name: axis.value_of(suggested[axis.name]) for axis in axes}


def _axis(text: str) -> SearchAxis:
    """Parse one text of `axes_of`; raises its errors. A bool without values has both as choices. Choices and
    names need at least two values, and a parameter of kind "name" has no default values."""
    name, given, bounds = (part.strip() for part in text.partition("="))
    spec = spec_of(name)
    why = _NO_PART_OF_THE_MAP.get(name.partition(".")[0])
    if why is not None:
        raise ParameterError(f"{name} {why}; it cannot be searched over", remedy="Set it with --set")
    if spec.minimum is None or spec.maximum is None:
        all_values = () if spec.kind == "name" else spec.choices or (False, True)
        values = grid_axis(name, [bounds]).values if given else all_values
        for value in values:
            Parameters().replace({name: value})  # raises an error with the syntax of a name
        if len(values) < 2:
            raise ParameterError(f"{text}: at least two values are needed", remedy=f"E.g. {name}=A,B")
        return SearchAxis(name, "choice", choices=tuple(v if isinstance(v, bool) else str(v) for v in values))
    low, high = _range(spec, bounds) if given else (spec.minimum, spec.maximum)
    return SearchAxis(name, "int" if spec.kind == "int" else "float", low, high)


def _range(spec: FieldSpec, bounds: str) -> tuple[float, float]:
    """Parse "LOW..HIGH" for a numeric parameter.

    Raises:
        ParameterError: The text is not two numbers (integers for kind "int"), the first one is not below the
            second one, or one is outside of the bounds of the declaration.
    """
    first, dots, last = bounds.partition("..")
    if not dots:
        example = f"{spec.name}={spec.minimum:g}..{spec.maximum:g}"
        raise ParameterError(
            f"{spec.name}={bounds}: not two numbers with .. between", remedy=f"E.g. {example}"
        )
    low, high = (checked_value(spec, end) for end in (first, last))
    if not float(low) < float(high):
        raise ParameterError(f"{spec.name}={bounds}: the lower bound must be less than the upper one")
    return float(low), float(high)


def _ends(axis: SearchAxis) -> tuple[Value, ...]:
    """Return the bounds of a number, rounded as the values of trials are, or all values of a choice."""
    if axis.kind == "choice":
        return axis.choices
    return axis.value_of(axis.low), axis.value_of(axis.high)


# --- plan and trials --------------------------------------------------------------------------------


class PlannedRun(msgspec.Struct, frozen=True):
    """A run of a search.

    Attributes:
        source: Source, and how it is mapped.
        truth: True trees; None for those of the source.
        truth_name: Name of the file of the true trees, for the provenance.
        held_out: Whether the run is only scored, and does not guide the search.
        annotations: Annotations from the list of runs, which replace and extend the true trees of the source;
            ignored if `truth` is given.
        digest: Digest of the recording to which the annotations belong; empty for any.
    """

    source: SourceRequest
    truth: tuple[Content, ...] | None = None
    truth_name: str = ""
    held_out: bool = False
    annotations: tuple[Content, ...] | None = None
    digest: str = ""


class Plan(msgspec.Struct, frozen=True):
    """A search.

    Attributes:
        runs: At least one that is not held out.
        axes: The parameters that are searched, with their bounds.
        start: Dict from stages to dicts from names to values, with all parameters with which the search
            begins. They are the first trial.
        kept: Folder of stored results; empty keeps them in memory.
        preset: Name of the preset from which the parameters come.
        goal, false_max: See `app.extensions.search.plan.Goal`.
        seed: Random seed of the mapping and of the sampler.
        odometry: Default source of the motion, see `app.sources.request`.
        trials: Number of trials.
        seconds: Time limit [s]; 0 for none.
    """

    runs: tuple[PlannedRun, ...]
    axes: tuple[SearchAxis, ...]
    start: dict[str, dict[str, Any]]
    kept: str = ""
    preset: str = "forest"
    goal: GoalName = "f1"
    false_max: float = 0.1
    seed: int = 0
    odometry: str = "auto"
    trials: int = 100
    seconds: float = 0.0

    @property
    def parameters(self) -> Parameters:
        """The parameters with which the search begins, validated at each access; raises ParameterError if
        `start` is invalid."""
        return validated({stage: dict(values) for stage, values in self.start.items()})

    @property
    def aim(self) -> Goal:
        """The goal of the search."""
        return Goal(self.goal, self.false_max)


class Trial(msgspec.Struct, frozen=True):
    """The result of one set of parameters.

    Attributes:
        number: Trials are numbered in the order in which they are suggested; -1 is the start of the search.
        values: Dict from the names of the searched parameters to the values of the set.
        loss: See `Goal.loss`; None where the values contradict one another.
        training, held_out: Scores by run. Held-out runs are scored only for a set that is the best so far.
    """

    number: int
    values: dict[str, Value]
    loss: float | None
    training: tuple[MapScores, ...] = ()
    held_out: tuple[MapScores, ...] = ()
