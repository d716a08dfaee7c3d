"""How a parameter is declared, and the whole set of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.config import stages
from pipeline.config.declare import Stage
from pipeline.errors import ParameterError

Value = float | int | bool | str


class Parameters(BaseModel):
    """All stages' parameters, in the order in which the data passes them."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    acquisition: stages.Acquisition = Field(default_factory=stages.Acquisition)
    filters: stages.Filters = Field(default_factory=stages.Filters)
    ground: stages.Ground = Field(default_factory=stages.Ground)
    clustering: stages.Clustering = Field(default_factory=stages.Clustering)
    shape: stages.Shape = Field(default_factory=stages.Shape)
    detection: stages.Detection = Field(default_factory=stages.Detection)
    slam: stages.Slam = Field(default_factory=stages.Slam)
    relocalisation: stages.Relocalisation = Field(default_factory=stages.Relocalisation)
    gathering: stages.Gathering = Field(default_factory=stages.Gathering)
    tracking: stages.Tracking = Field(default_factory=stages.Tracking)
    obstacles: stages.Obstacles = Field(default_factory=stages.Obstacles)
    evaluation: stages.Evaluation = Field(default_factory=stages.Evaluation)

    def replace(self, changes: dict[str, Any]) -> Parameters:
        """A new set with values changed by their dotted names, validated as a whole.

        Raises:
            ParameterError: A name is unknown, a value is out of bounds, or two values contradict.
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
        """Every value by its dotted name, in the order of the stages."""
        return {
            f"{stage}.{name}": value
            for stage, values in self.model_dump().items()
            for name, value in values.items()
        }

    def changes_from(self, other: Parameters) -> dict[str, Value]:
        """The values, by dotted name, that differ from another set."""
        theirs = other.flat()
        return {name: value for name, value in self.flat().items() if theirs[name] != value}


def validated(tree: dict[str, Any]) -> Parameters:
    """Parameters from nested dicts.

    Raises:
        ParameterError: One line that names the parameter, its bound and the value given.
    """
    try:
        return Parameters.model_validate(tree)
    except ValidationError as error:
        raise ParameterError(_first_message(error)) from None


def _first_message(error: ValidationError) -> str:
    first = error.errors()[0]
    name = ".".join(str(part) for part in first["loc"])
    if first["type"] == "value_error":  # a rule across fields, which names them itself
        return str(first["ctx"]["error"])
    if first["type"] == "extra_forbidden":
        return f"there is no parameter {name!r}{_nearest(name)}"
    what = first["msg"].removeprefix("Input ")
    return f"{name} = {first['input']!r}: {what[0].lower()}{what[1:]}"


def _nearest(name: str) -> str:
    import difflib

    close = difflib.get_close_matches(name, [spec.name for spec in field_specs()], n=1)
    return f"; the nearest is {close[0]!r}" if close else ""


@dataclass(frozen=True, slots=True)
class FieldSpec:
    """One parameter as a slider, a schema or a table row needs it.

    Attributes:
        name: Dotted, e.g. "clustering.eps".
        stage: The stage's title.
        title, unit, doc: For people.
        kind: "float", "int", "bool", "choice" or "name".
        minimum, maximum, step: Of numbers, else None.
        choices: Of a choice, else empty.
        default: Of the preset `forest`.
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
    choices: tuple[str, ...]
    default: Value


def field_specs() -> tuple[FieldSpec, ...]:
    """Every parameter, in the order of the stages."""
    return tuple(
        _spec(stage_name, stage_model, name)
        for stage_name, stage_field in Parameters.model_fields.items()
        if isinstance(stage_model := stage_field.annotation, type) and issubclass(stage_model, Stage)
        for name in stage_model.model_fields
    )


def _spec(stage_name: str, stage_model: type[Stage], name: str) -> FieldSpec:
    field = stage_model.model_fields[name]
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    bounds = {type(m).__name__: m for m in field.metadata}
    minimum, maximum = bounds.get("Ge"), bounds.get("Le")
    kind: Literal["float", "int", "bool", "choice", "name"]
    choices: tuple[str, ...] = ()
    if get_origin(field.annotation) is Literal:
        kind, choices = "choice", get_args(field.annotation)
    elif field.annotation is bool:
        kind = "bool"
    elif field.annotation is int:
        kind = "int"
    elif field.annotation is str:
        kind = "name"
    else:
        kind = "float"
    step = extra.get("step")
    return FieldSpec(
        name=f"{stage_name}.{name}",
        stage=stage_model.title(),
        title=field.title or name,
        unit=str(extra.get("unit", "")),
        doc=field.description or "",
        kind=kind,
        minimum=None if minimum is None else float(minimum.ge),
        maximum=None if maximum is None else float(maximum.le),
        step=None if not isinstance(step, int | float) else float(step),
        choices=choices,
        default=field.default,
    )
