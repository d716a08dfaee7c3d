"""The set of all parameters, its validation, a description of each field, and parameters as text:
`stage.name=value`, TOML, and the table in docs/parameters.md."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.config import stages
from pipeline.config.stages import Stage
from pipeline.errors import ParameterError

Value = float | int | bool | str


class Parameters(BaseModel):
    """The parameters of all stages, in the order in which a scan passes the stages."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    acquisition: stages.Acquisition = Field(default_factory=stages.Acquisition)
    filters: stages.Filters = Field(default_factory=stages.Filters)
    ground: stages.Ground = Field(default_factory=stages.Ground)
    clustering: stages.Clustering = Field(default_factory=stages.Clustering)
    shape: stages.Shape = Field(default_factory=stages.Shape)
    detection: stages.Detection = Field(default_factory=stages.Detection)
    slam: stages.Slam = Field(default_factory=stages.Slam)
    relocalisation: stages.Relocalisation = Field(default_factory=stages.Relocalisation)
    classification: stages.Classification = Field(default_factory=stages.Classification)
    tracking: stages.Tracking = Field(default_factory=stages.Tracking)
    obstacles: stages.Obstacles = Field(default_factory=stages.Obstacles)
    evaluation: stages.Evaluation = Field(default_factory=stages.Evaluation)

    def replace(self, changes: Mapping[str, Any]) -> Parameters:
        """Return a copy in which the values with the dotted names in `changes` are replaced, validated as a
        whole.

        Raises:
            ParameterError: A name is unknown, a value has the wrong type or is out of bounds, or two values
                contradict each other.
        """
        tree = self.model_dump()
        for name, value in changes.items():
            stage, _, field_name = name.partition(".")
            if stage not in tree or field_name not in tree[stage]:
                raise ParameterError(
                    f"there is no parameter {name!r}",
                    remedy=f"`stemmap params` lists them{_nearest(name)}",
                )
            tree[stage][field_name] = value
        return validated(tree)

    def flat(self) -> dict[str, Value]:
        """Return a dict from the dotted names of all parameters, in the order of the stages, to their
        values."""
        return {
            f"{stage}.{name}": value
            for stage, values in self.model_dump().items()
            for name, value in values.items()
        }

    def changes_from(self, other: Parameters) -> dict[str, Value]:
        """Return a dict from dotted names to the values of this set that differ from those of `other`; empty
        for equal sets."""
        others = other.flat()
        return {name: value for name, value in self.flat().items() if others[name] != value}


def validated(tree: Mapping[str, Any]) -> Parameters:
    """Return parameters from nested mappings (stage, parameter). Stages and parameters that are missing have
    their defaults, those of the preset `forest`.

    Raises:
        ParameterError: A name is unknown, a value has the wrong type or is out of bounds, or two values
            contradict each other. The message describes the first error in one line.
    """
    try:
        return Parameters.model_validate(tree)
    except ValidationError as error:
        raise ParameterError(_first_message(error)) from None


def _first_message(error: ValidationError) -> str:
    """Return the first error of a validation as one line: the dotted name, the value given and the reason.
    For an unknown name it gives the nearest known one, for a rule across parameters only the message of the
    rule."""
    first = error.errors()[0]
    name = ".".join(str(part) for part in first["loc"])
    if first["type"] == "value_error":  # a rule across fields, whose message names them
        return str(first["ctx"]["error"])
    if first["type"] == "extra_forbidden":
        return f"there is no parameter {name!r}{_nearest(name)}"
    message = first["msg"].removeprefix("Input ")
    return f"{name} = {first['input']!r}: {message[0].lower()}{message[1:]}"


def _nearest(name: str) -> str:
    """Return the text "; the nearest is ..." with the most similar parameter name; "" if no name is
    similar."""
    close = difflib.get_close_matches(name, [spec.name for spec in field_specs()], n=1)
    return f"; the nearest is {close[0]!r}" if close else ""


@dataclass(frozen=True, slots=True)
class FieldSpec:
    """Description of one parameter, from which sliders, schemas and tables are made.

    Attributes:
        name: Dotted name, for example "clustering.eps".
        stage: Title of the stage.
        title: Short label.
        unit: Unit symbol; "" if dimensionless.
        doc: One sentence of explanation.
        kind: Type of the value.
        minimum, maximum, step: Bounds and slider increment of a number; None for other kinds.
        shown: Range of the slider of a number; None for other kinds.
        log: Whether the slider is logarithmic: its range is positive and spans a factor of 8 or more.
        main: Whether the parameter has a slider next to the 3D scene.
        choices: Valid values of a choice; empty for other kinds.
        default: Value in the preset `forest`.
    """

    name: str
    stage: str
    title: str
    unit: str
    doc: str
    kind: Literal["float", "int", "bool", "choice", "name"]
    minimum: float | None
    maximum: float | None
    step: float | None
    shown: tuple[float, float] | None
    log: bool
    main: bool
    choices: tuple[str, ...]
    default: Value


#: Kind of the other parameters by the type of their values.
_KINDS: dict[Any, Literal["float", "int", "bool", "choice", "name"]] = {
    float: "float",
    int: "int",
    bool: "bool",
    str: "name",
}


def field_specs() -> tuple[FieldSpec, ...]:
    """Return the description of every parameter, in the order of the stages."""
    return tuple(
        spec
        for stage_name, stage_field in Parameters.model_fields.items()
        if isinstance(stage_model := stage_field.annotation, type) and issubclass(stage_model, Stage)
        for spec in stage_specs(stage_name, stage_model)
    )


def stage_specs(stage_name: str, stage_model: type[Stage]) -> tuple[FieldSpec, ...]:
    """Return the description of every parameter of a stage, which need not be one of `Parameters`.

    Args:
        stage_name: Name of the stage in dotted names.
        stage_model: Class with the declarations.
    """
    return tuple(_spec(stage_name, stage_model, name) for name in stage_model.model_fields)


def _spec(stage_name: str, stage_model: type[Stage], name: str) -> FieldSpec:
    """Return the description of one parameter. Its kind follows the annotation: Literal is "choice", str
    "name".

    Args:
        stage_name: Name of the stage in dotted names.
        stage_model: Class with the declaration.
        name: Name of the parameter in the stage.
    """
    field = stage_model.model_fields[name]
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    bounds = {type(m).__name__: m for m in field.metadata}
    minimum, maximum = bounds.get("Ge"), bounds.get("Le")
    choices = get_args(field.annotation)
    step, shown = extra.get("step"), extra.get("shown")
    low, high = (float(str(end)) for end in shown) if isinstance(shown, list) else (0.0, 0.0)  # of a number
    return FieldSpec(
        name=f"{stage_name}.{name}",
        stage=stage_model.title(),
        title=field.title or name,
        unit=str(extra.get("unit", "")),
        doc=" ".join((field.description or "").split()),
        kind="choice" if choices else _KINDS[field.annotation],
        minimum=None if minimum is None else float(minimum.ge),
        maximum=None if maximum is None else float(maximum.le),
        step=None if not isinstance(step, int | float) else float(step),
        shown=(low, high) if shown else None,
        log=0.0 < 8.0 * low <= high,
        main=bool(extra.get("main")),
        choices=choices,
        default=field.default,
    )


# --- as text ---

LONGEST_TOML = 1_000_000  # characters
#: A name of more parts: tomllib takes gigabytes for names of thousands of parts.
_DEEP_NAME = re.compile(r"(?:\.[^.,=\n]{0,100}){20}")


def assign(parameters: Parameters, assignments: list[str]) -> Parameters:
    """Return parameters changed by `stage.name=value` texts of the command line. Spaces around name and value
    are ignored; of two texts with one name the later one counts.

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
        {name: parsed(specs[name], value) if name in specs else value for name, value in changes.items()}
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
    """Return the base set with the values of a TOML text; the text may omit stages and values.

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
    tree: dict[str, Any] = base.model_dump()
    for stage, values in given.items():
        # TOML distinguishes 1 from 1.0; both are valid for a floating-point parameter.
        tree.setdefault(stage, {}).update(values)
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
        [f"`{s.name}`", s.unit, _bounds(s), *(value_text(values[p][s.name]) for p in presets), s.doc]
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
