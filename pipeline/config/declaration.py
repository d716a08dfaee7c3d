"""Helpers with which a stage declares its parameters."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class Stage(BaseModel):
    """Parameters of one stage: immutable, strictly typed, without unknown names, NaN or infinity."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def title(cls) -> str:
        """Return the name of the stage for people: its docstring up to the first colon."""
        return (cls.__doc__ or cls.__name__).partition(":")[0].strip()


def number(default: float, title: str, unit: str, low: float, high: float, step: float, doc: str) -> Any:  # noqa: ANN401 - pydantic's Field is the default of a field of any type
    """Declare a floating-point parameter in [low, high]; `step` is the increment of its slider."""
    return Field(
        default=default,
        title=title,
        description=doc,
        ge=low,
        le=high,
        json_schema_extra={"unit": unit, "step": step},
    )


def count(default: int, title: str, unit: str, low: int, high: int, doc: str) -> Any:  # noqa: ANN401
    """Declare an integer parameter in [low, high]."""
    return Field(
        default=default,
        title=title,
        description=doc,
        ge=low,
        le=high,
        json_schema_extra={"unit": unit, "step": 1},
    )


def name(default: str, title: str, pattern: str, doc: str) -> Any:  # noqa: ANN401
    """Declare a parameter that holds a name; the regular expression `pattern` defines valid names."""
    return Field(default=default, title=title, description=doc, pattern=pattern)


def choice(default: str | bool, title: str, doc: str) -> Any:  # noqa: ANN401
    """Declare a parameter whose type is a Literal of words, or bool."""
    return Field(default=default, title=title, description=doc)
