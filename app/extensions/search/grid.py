"""Parameter grids: every combination of the values that the user names.

On the command line a parameter is `NAME=VALUES`, with values as `--set` takes them: a list `0.1,0.15,0.2`, a
range with its number of values `0.1..0.4/7` (ends included), `0.01..1/5log` with equal ratios, or both in one
list. A TOML file has one table per stage, with lists or the same texts.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.config import PRESETS, FieldSpec, Parameters, field_specs
from pipeline.config.model import Value, parsed, toml_table, value_text
from pipeline.errors import ParameterError

PRESET = "preset"  # the axis whose values are names of presets, which the other axes change
MOST_SETS = 20_000
MOST_VALUES = 1_000
_LARGEST_FILE = 1 << 20
_COUNT = re.compile(r"(\d{1,6})(log)?")
_EXAMPLE = "E.g. --param-grid clustering.eps=0.1,0.15,0.2 or clustering.eps=0.1..0.4/7"


@dataclass(frozen=True, slots=True)
class GridAxis:
    """A parameter, by its dotted name or PRESET, and its different values."""

    name: str
    values: tuple[Value, ...]


def read_axes(words: Iterable[str]) -> tuple[GridAxis, ...]:
    """Return the axes that `--param-grid` names, in their order; () without words.

    Args:
        words: `NAME=VALUES`, or the name of a TOML file.

    Raises:
        ParameterError: A name, a value or a file is invalid, a name is given twice, or there are more than
            `MOST_SETS` sets.
    """
    axes: dict[str, GridAxis] = {}
    for word in words:
        name, equals, text = (part.strip() for part in word.partition("="))
        found = [grid_axis(name, [text])] if equals else _axes_of(Path(word))
        for axis in found:
            if axis.name in axes:
                raise ParameterError(f"{axis.name} is given twice", remedy="Put its values into one list")
            axes[axis.name] = axis
    sets = math.prod(len(axis.values) for axis in axes.values())
    if sets > MOST_SETS:
        raise ParameterError(
            f"{' x '.join(str(len(axis.values)) for axis in axes.values())} values are {sets:,} sets, "
            f"more than {MOST_SETS:,}",
            remedy="Ask for fewer values, or search with `stemmap tune`",
        )
    return tuple(axes.values())


def spec_of(name: str) -> FieldSpec:
    """Return the declaration of a parameter.

    Raises:
        ParameterError: There is no such parameter; the error names the nearest one.
    """
    spec = next((spec for spec in field_specs() if spec.name == name), None)
    if spec is None:
        Parameters().replace({name: 0})
        raise ParameterError(f"there is no parameter {name!r}")
    return spec


def combinations(axes: Sequence[GridAxis]) -> list[dict[str, Value]]:
    """Return every combination of the values, each a dict from parameter name to value. The last axis changes
    fastest. If there are no axes, the result is [{}]."""
    return [
        dict(zip((axis.name for axis in axes), values, strict=True))
        for values in itertools.product(*(axis.values for axis in axes))
    ]


def words_of(changes: Mapping[str, Value]) -> str:
    """Return a combination as text, "NAME=VALUE" separated by spaces; "unchanged" for an empty one."""
    return " ".join(f"{name}={value_text(value)}" for name, value in changes.items()) or "unchanged"


def _axes_of(file: Path) -> list[GridAxis]:
    """Return the axes of a TOML file with one table per stage and the optional key `preset`.

    Raises:
        ParameterError: The file cannot be read, is larger than 1 MB, or has invalid names or values.
    """
    try:
        if file.stat().st_size > _LARGEST_FILE:
            raise ParameterError("the file is larger than 1 MB", where=str(file))
        given = toml_table(file.read_text(encoding="utf-8"), str(file))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise ParameterError(f"cannot read the grid: {reason}", where=str(file), remedy=_EXAMPLE) from None
    axes = []
    for stage, entry in given.items():
        if stage == PRESET:
            axes.append(grid_axis(PRESET, entry if isinstance(entry, list) else [entry]))
        elif isinstance(entry, dict):
            axes += [
                grid_axis(f"{stage}.{name}", values if isinstance(values, list) else [values])
                for name, values in entry.items()
            ]
        else:
            raise ParameterError(
                f"{stage} is not in the table of a stage",
                where=str(file),
                remedy="Write it below a line [stage]",
            )
    return axes


def grid_axis(name: str, entries: Sequence[Any]) -> GridAxis:
    """Return the axis of a parameter or PRESET; equal values are merged.

    Args:
        name: Dotted name, or PRESET.
        entries: Values, or strings in the syntax of the command line.

    Raises:
        ParameterError: The name is unknown, a value is invalid or out of bounds, or a parameter has no values
            or more than `MOST_VALUES`. PRESET may have any number of values.
    """
    if name == PRESET:
        values: list[Value] = [word for entry in entries for word in _parts(str(entry))]
        unknown = [value for value in values if value not in PRESETS]
        if unknown:
            raise ParameterError(
                f"there is no preset {unknown[0]!r}", remedy=f"Presets: {', '.join(PRESETS)}"
            )
        return GridAxis(PRESET, tuple(dict.fromkeys(values)))
    spec = spec_of(name)
    values = [value for entry in entries for part in _parts(_text(entry)) for value in _values(spec, part)]
    if not values or len(values) > MOST_VALUES:
        raise ParameterError(f"{name} has {len(values):,} values, not 1 to {MOST_VALUES:,}", remedy=_EXAMPLE)
    return GridAxis(name, tuple(dict.fromkeys(values)))


def _text(entry: object) -> str:
    """Return an entry of a TOML file as text in the syntax of the command line; a bool in lower case."""
    return str(entry).lower() if isinstance(entry, bool) else str(entry)


def _parts(text: str) -> list[str]:
    """Split a text at its commas; blank parts are dropped."""
    return [part.strip() for part in text.split(",") if part.strip()]


def _values(spec: FieldSpec, text: str) -> list[Value]:
    """Return the values of one part of a list: a single value, or those of a range "LOW..HIGH/COUNT" or
    "LOW..HIGH/COUNTlog".

    Raises:
        ParameterError: The text cannot be parsed, a value is out of bounds, a range has fewer than 2 or more
            than `MOST_VALUES` values, or its ends are not above 0 for "log".
    """
    start, dots, rest = text.partition("..")
    if not dots:
        return [checked_value(spec, text)]
    end, _, how_many = rest.rpartition("/")  # the last slash: units contain slashes too
    counted = _COUNT.fullmatch(how_many.strip())
    if spec.kind not in ("int", "float") or counted is None:
        raise ParameterError(
            f"{spec.name} = {text!r} is not a range of numbers with a number of values", remedy=_EXAMPLE
        )
    low, high = float(checked_value(spec, start)), float(checked_value(spec, end))
    count, ratio = int(counted[1]), counted[2] is not None
    if not 2 <= count <= MOST_VALUES:
        raise ParameterError(
            f"{spec.name} = {text!r}: a range has 2 to {MOST_VALUES:,} values", remedy=_EXAMPLE
        )
    if ratio and min(low, high) <= 0.0:
        raise ParameterError(f"{spec.name} = {text!r}: equal ratios need numbers above 0", remedy=_EXAMPLE)
    return [_rounded(spec, value) for value in spread(low, high, count, ratio=ratio)]


def spread(low: float, high: float, count: int, *, ratio: bool) -> list[float]:
    """Return `count` values from low to high, ends included and exact.

    Args:
        low, high: The ends, in any order; both above 0 for equal ratios.
        count: Number of values, at least 2.
        ratio: Whether neighbouring values have equal ratios; otherwise equal differences.
    """
    shares = [k / (count - 1) for k in range(count)]
    if ratio:
        between = [low * (high / low) ** share for share in shares]
    else:
        between = [low + (high - low) * share for share in shares]
    return [low, *between[1:-1], high]


def _rounded(spec: FieldSpec, value: float) -> Value:
    """Return a value of a range, rounded to an integer for kind "int", otherwise to 12 significant digits."""
    # Twelve digits, so that 0.1..0.3/3 contains exactly 0.2.
    return round(value) if spec.kind == "int" else float(f"{value:.12g}")


def checked_value(spec: FieldSpec, text: str) -> Value:
    """Return the value of a text, with or without its unit. Contradictions between two values depend on the
    other parameters and are not checked.

    Raises:
        ParameterError: The value is invalid, or outside of the bounds or choices of the parameter.
    """
    bare = text.strip()
    if spec.kind in ("int", "float") and spec.unit:
        bare = bare.removesuffix(spec.unit).strip()
    value = parsed(spec, bare)
    if spec.kind in ("int", "float") and spec.minimum is not None and spec.maximum is not None:
        if not spec.minimum <= float(value) <= spec.maximum:
            raise ParameterError(
                f"{spec.name} = {value_text(value)} is not within {spec.minimum:g} to {spec.maximum:g}"
            )
    elif (spec.kind == "choice" and value not in spec.choices) or (
        spec.kind == "bool" and not isinstance(value, bool)
    ):
        raise ParameterError(
            f"{spec.name} = {value!r} is not one of {', '.join(spec.choices) or 'true, false'}"
        )
    return value
