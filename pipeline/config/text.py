"""Parameters as text: `stage.name=value`, TOML, and the table in docs/parameters.md."""

from __future__ import annotations

import re
import tomllib
from typing import Any

from pipeline.config.model import FieldSpec, Parameters, Value, current_names, field_specs, validated
from pipeline.errors import ParameterError

LONGEST_TOML = 1_000_000  # characters
#: A name of more parts: tomllib takes gigabytes for names of thousands of parts.
_DEEP_NAME = re.compile(r"(?:\.[^.,=\n]{0,100}){20}")


def assign(parameters: Parameters, assignments: list[str]) -> Parameters:
    """Return parameters changed by `stage.name=value` texts of the command line. Spaces around name and value
    are ignored; of two texts with one name the later one counts. Names of earlier versions give a
    RenamedParameterWarning, and removed parameters are ignored with such a warning, see `current_names`.

    Raises:
        ParameterError: A text has no "=", a name is unknown, or a value is not valid.
    """
    specs = {spec.name: spec for spec in field_specs()}
    changes: dict[str, str] = {}
    for text in assignments:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise ParameterError(f"{text!r} is not stage.name=value", remedy="E.g. --set clustering.eps=0.3")
        changes[name] = value
    return parameters.replace(
        {
            name: parsed(specs[name], value) if name in specs else value
            for name, value in current_names(changes).items()
        }
    )


def value_text(value: Value) -> str:
    """Return the value of a parameter in the syntax of `--set`, for example "0.2", "true" or "dbscan". Floats
    have up to six significant digits."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def parsed(spec: FieldSpec, text: str) -> Value:
    """Return the value of a parameter from its text; bounds and choices are not checked, and "nan" and "inf"
    are numbers of type float. The text of a bool other than "true" and "false" is returned unchanged.

    Raises:
        ParameterError: The text of a numeric parameter is not a number.
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
    """Return all values, also those equal to a default, as TOML text with one table per stage, in the order
    of the stages."""
    import tomli_w

    return tomli_w.dumps(parameters.model_dump())


def from_toml(text: str, base: Parameters, where: str) -> Parameters:
    """Return the base set with the values of a TOML text; the text may omit stages and values. Names of
    earlier versions give a RenamedParameterWarning, and removed parameters are ignored with such a warning,
    see `current_names`.

    Args:
        text: Content of the file.
        base: Values of the parameters that the text omits; not changed.
        where: Name of the file, for error messages.

    Raises:
        ParameterError: The text is not TOML (see `toml_table`), a value is not in a table, a name is unknown,
            or a value is not valid.
    """
    given = toml_table(text, where)
    for stage, values in given.items():
        if not isinstance(values, dict):
            raise ParameterError(
                f"{stage} is not inside a stage", where=where, remedy="Write it below a line [stage]"
            )
    values = current_names({f"{stage}.{name}": v for stage, vs in given.items() for name, v in vs.items()})
    tree: dict[str, Any] = base.model_dump()
    for dotted, value in values.items():
        stage, _, name = dotted.partition(".")
        # TOML distinguishes 1 from 1.0; both are valid for a floating-point parameter.
        tree.setdefault(stage, {})[name] = value
    try:
        return validated(tree)
    except ParameterError as error:
        raise ParameterError(error.what, where=where) from None


def toml_table(text: str, where: str) -> dict[str, Any]:
    """Return the top-level table of a TOML text as a dict, without a check of names and values.

    Args:
        text: Content of the file.
        where: Name of the file, for error messages.

    Raises:
        ParameterError: The text is not TOML, is longer than LONGEST_TOML, or has names of too many parts.
    """
    if len(text) > LONGEST_TOML:
        raise ParameterError(f"the file is longer than {LONGEST_TOML:,} characters", where=where)
    if _DEEP_NAME.search(text):
        raise ParameterError("a name in the file has too many parts", where=where)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # a TOMLDecodeError is a ValueError
        raise ParameterError(f"not a TOML file: {error}", where=where) from None


def markdown_table(presets: dict[str, Parameters]) -> str:
    """Return a Markdown table of every parameter with unit, bounds, its value in each preset, and meaning;
    one row per parameter, with a final line break.

    Args:
        presets: Dict from names of presets to their parameters; each gives a column.
    """
    values = {name: parameters.flat() for name, parameters in presets.items()}
    head = ["parameter", "unit", "bounds", *(f"`{name}`" for name in presets), "meaning"]
    rows = [
        [f"`{s.name}`", s.unit, _bounds(s), *(_shown(values[p][s.name]) for p in presets), s.doc]
        for s in field_specs()
    ]
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines) + "\n"


def _bounds(spec: FieldSpec) -> str:
    """Return the bounds of a number as "low to high", else the choices, "true, false" or "a name"."""
    if spec.kind == "name":
        return "a name"
    if spec.minimum is None or spec.maximum is None:
        return ", ".join(spec.choices) or "true, false"
    return f"{spec.minimum:g} to {spec.maximum:g}"


def _shown(value: Value) -> str:
    """Return a value as text; floating-point numbers in their shortest form with up to six digits, a bool as
    "True" or "False"."""
    return f"{value:g}" if isinstance(value, float) else str(value)
