"""The parameters that a search varies, and their bounds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any, Literal

import msgspec

from pipeline.config import FieldSpec, Parameters, field_specs
from pipeline.config.model import Value
from pipeline.errors import ParameterError

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


class Axis(msgspec.Struct, frozen=True):
    """A parameter of a search.

    Attributes:
        low, high: Of a number.
        choices: Of a choice or a switch.
    """

    name: str
    kind: Literal["float", "int", "choice"]
    low: float = 0.0
    high: float = 0.0
    choices: tuple[str | bool, ...] = ()

    def suggest(self, trial: Any) -> None:  # noqa: ANN401 - Optuna has no types
        """Let a trial of Optuna choose a value; it is in the trial's `params` afterwards."""
        log = self.low > 0.0 and self.high >= _LOG_FROM * self.low
        if self.kind == "choice":
            trial.suggest_categorical(self.name, self.choices)
        elif self.kind == "int":
            trial.suggest_int(self.name, int(self.low), int(self.high), log=log)
        else:
            trial.suggest_float(self.name, self.low, self.high, log=log)

    def value_of(self, suggested: Any) -> Value:  # noqa: ANN401
        """Return the parameter's value for a suggestion of Optuna: few digits, within the bounds."""
        if self.kind == "choice":
            return suggested if isinstance(suggested, bool) else str(suggested)
        if self.kind == "int":
            return int(suggested)
        return min(max(float(f"{suggested:.{_DIGITS}g}"), self.low), self.high)

    def holds(self, value: Value) -> bool:
        """Whether a value is within the bounds."""
        if self.kind == "choice":
            return any(type(c) is type(value) and c == value for c in self.choices)
        return not isinstance(value, str) and self.low <= value <= self.high

    @property
    def words(self) -> str:
        """The axis in the syntax of --over."""
        if self.kind == "choice":
            return f"{self.name}={','.join(_word(c) for c in self.choices)}"
        return f"{self.name}={self.low:g}..{self.high:g}"


def axes_of(texts: Sequence[str]) -> tuple[Axis, ...]:
    """Return the axes of `NAME`, `NAME=LOW..HIGH` or `NAME=A,B`.

    Raises:
        ParameterError: A name is unknown or named twice, or its bounds contradict its declaration.
    """
    axes = tuple(_axis(text) for text in texts)
    names = [axis.name for axis in axes]
    for name in names:
        if names.count(name) > 1:
            raise ParameterError(f"{name} is given twice", remedy="Name it once")
    return axes


def check(axes: Iterable[Axis], start: Parameters) -> None:
    """Check that the bounds contain a set without contradictions.

    Raises:
        ParameterError: All corners of the space contradict themselves; the message names the contradiction.
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


def values_of(axes: Iterable[Axis], suggested: Mapping[str, Any]) -> dict[str, Value]:
    """Return the values of the parameters by name."""
    return {axis.name: axis.value_of(suggested[axis.name]) for axis in axes}


def _axis(text: str) -> Axis:
    name, given, bounds = (part.strip() for part in text.partition("="))
    spec = next((spec for spec in field_specs() if spec.name == name), None)
    if spec is None:
        Parameters().replace({name: 0})  # raises an error that names the nearest parameter
        raise ParameterError(f"there is no parameter {name!r}")
    why = _NO_PART_OF_THE_MAP.get(name.partition(".")[0])
    if why is not None:
        raise ParameterError(f"{name} {why}; it cannot be searched over", remedy="Set it with --set")
    if spec.kind == "name":
        return _names(spec, bounds)
    if spec.minimum is None or spec.maximum is None:
        return _choice(spec, bounds) if given else Axis(name, "choice", choices=_all_choices(spec))
    low, high = _range(spec, bounds) if given else (spec.minimum, spec.maximum)
    return Axis(name, "int" if spec.kind == "int" else "float", low, high)


def _range(spec: FieldSpec, bounds: str) -> tuple[float, float]:
    first, dots, last = bounds.partition("..")
    try:
        if not dots:
            raise ValueError
        whole = spec.kind == "int"
        low, high = (float(int(end)) if whole else float(end) for end in (first, last))
    except (ValueError, OverflowError):
        kind = "whole numbers" if spec.kind == "int" else "numbers"
        raise ParameterError(
            f"{spec.name}={bounds}: not two {kind} with .. between", remedy=f"E.g. {_example(spec)}"
        ) from None
    assert spec.minimum is not None  # noqa: S101 - it is a number
    assert spec.maximum is not None  # noqa: S101
    if not low < high:
        raise ParameterError(f"{spec.name}={bounds}: the lower bound must be less than the upper one")
    if not (spec.minimum <= low and high <= spec.maximum):
        raise ParameterError(
            f"{spec.name}={bounds} is outside of the parameter's range",
            remedy=f"It goes from {spec.minimum:g} to {spec.maximum:g}",
        )
    return low, high


def _choice(spec: FieldSpec, words: str) -> Axis:
    known = {_word(choice): choice for choice in _all_choices(spec)}
    asked = [word.strip() for word in words.split(",")]
    unknown = [word for word in asked if word not in known]
    if unknown or len(set(asked)) < 2:
        what = f"{unknown[0]!r} is not one of its values" if unknown else "at least two values are needed"
        raise ParameterError(f"{spec.name}={words}: {what}", remedy=f"Choose from {', '.join(known)}")
    return Axis(spec.name, "choice", choices=tuple(known[word] for word in dict.fromkeys(asked)))


def _names(spec: FieldSpec, words: str) -> Axis:
    asked = tuple(dict.fromkeys(word.strip() for word in words.split(",") if word.strip()))
    if len(asked) < 2:
        raise ParameterError(
            f"{spec.name} is a name and has no bounds", remedy=f"Give at least two names: {spec.name}=A,B"
        )
    for word in asked:
        Parameters().replace({spec.name: word})  # raises an error that says how a name is written
    return Axis(spec.name, "choice", choices=asked)


def _all_choices(spec: FieldSpec) -> tuple[str | bool, ...]:
    return spec.choices or (False, True)


def _ends(axis: Axis) -> tuple[Value, ...]:
    if axis.kind == "choice":
        return axis.choices
    return axis.value_of(axis.low), axis.value_of(axis.high)


def _word(choice: str | bool) -> str:
    return str(choice).lower() if isinstance(choice, bool) else choice


def _example(spec: FieldSpec) -> str:
    return f"{spec.name}={spec.minimum:g}..{spec.maximum:g}"
