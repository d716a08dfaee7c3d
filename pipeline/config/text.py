"""Parameters as text: `stage.name=value`, TOML, and the table in README."""

from __future__ import annotations

import math
import tomllib
from typing import Any

from pipeline.config.model import FieldSpec, Parameters, Value, field_specs, validated
from pipeline.errors import ParameterError


def assign(parameters: Parameters, assignments: list[str]) -> Parameters:
    """Apply `stage.name=value` texts as they come from the command line.

    Raises:
        ParameterError: A text has no "=", a name is unknown, or a value does not fit.
    """
    specs = {spec.name: spec for spec in field_specs()}
    changes: dict[str, Any] = {}
    for text in assignments:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise ParameterError(f"{text!r} is not stage.name=value", remedy="E.g. --set clustering.eps=0.3")
        changes[name] = parsed(specs[name], value) if name in specs else value
    return parameters.replace(changes)


def parsed(spec: FieldSpec, text: str) -> Value:
    """A value of a parameter from the command line; its bounds are looked at with the whole set.

    Raises:
        ParameterError: It is to be a number and is none.
    """
    try:
        if spec.kind == "int":
            return int(text)
        if spec.kind == "float":
            return float(text)
    except ValueError:
        kind = "a whole number" if spec.kind == "int" else "a number"
        raise ParameterError(f"{spec.name} = {text!r}: should be {kind}") from None
    if spec.kind == "bool" and text in ("true", "false"):
        return text == "true"
    return text


def to_toml(parameters: Parameters) -> str:
    """All values as TOML, one table a stage."""
    import tomli_w

    return tomli_w.dumps(parameters.model_dump())


def from_toml(text: str, base: Parameters, where: str) -> Parameters:
    """Values from TOML laid over a base set; stages and values may be missing.

    Args:
        text: The file's text.
        base: What holds where the text says nothing.
        where: The file's name, for the error.

    Raises:
        ParameterError: The text is not TOML, or a value does not fit.
    """
    try:
        given = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a TOMLDecodeError is a ValueError
        raise ParameterError(f"not a TOML file: {error}", where=where) from None
    tree: dict[str, Any] = base.model_dump()
    for stage, values in given.items():
        if not isinstance(values, dict):
            raise ParameterError(
                f"{stage} stands outside of a stage", where=where, remedy="Write it below a line [stage]"
            )
        floats = {
            s.name.partition(".")[2]
            for s in field_specs()
            if s.name.startswith(f"{stage}.") and s.kind == "float"
        }
        # TOML tells 1 from 1.0; a person who writes 1 for a length means 1.0.
        tree.setdefault(stage, {}).update(
            {k: _as_float(v) if k in floats and type(v) is int else v for k, v in values.items()}
        )
    try:
        return validated(tree)
    except ParameterError as error:
        raise ParameterError(error.what, where=where) from None


def _as_float(value: int) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf  # which every bound refuses


def markdown_table(presets: dict[str, Parameters]) -> str:
    """A table of every parameter with its bounds and its value in each preset."""
    values = {name: parameters.flat() for name, parameters in presets.items()}
    head = ["parameter", "unit", "bounds", *(f"`{name}`" for name in presets), "meaning"]
    rows = [
        [f"`{s.name}`", s.unit, _bounds(s), *(_shown(values[p][s.name]) for p in presets), s.doc]
        for s in field_specs()
    ]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"


def _bounds(spec: FieldSpec) -> str:
    if spec.kind == "name":
        return "a name"
    if spec.minimum is None or spec.maximum is None:
        return ", ".join(spec.choices) or "true, false"
    return f"{spec.minimum:g} to {spec.maximum:g}"


def _shown(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
