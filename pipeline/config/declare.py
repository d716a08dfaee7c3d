"""The words in which a stage declares its parameters."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class Stage(BaseModel):
    """The parameters of one stage: frozen, strict, nothing unknown, no NaN and no infinity."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def title(cls) -> str:
        """The stage's name for people: the first line of its docstring up to the colon."""
        return (cls.__doc__ or cls.__name__).partition(":")[0].strip()


def number(default: float, title: str, unit: str, low: float, high: float, step: float, doc: str) -> Any:  # noqa: ANN401 - pydantic's Field is the default of a field of any type
    """A number in [low, high]; `step` is what a slider moves by."""
    return Field(
        default=default,
        title=title,
        description=doc,
        ge=low,
        le=high,
        json_schema_extra={"unit": unit, "step": step},
    )


def count(default: int, title: str, unit: str, low: int, high: int, doc: str) -> Any:  # noqa: ANN401
    """A whole number in [low, high]."""
    return Field(
        default=default,
        title=title,
        description=doc,
        ge=low,
        le=high,
        json_schema_extra={"unit": unit, "step": 1},
    )


def name(default: str, title: str, pattern: str, doc: str) -> Any:  # noqa: ANN401
    """A word that names something; what names look like is a regular expression."""
    return Field(default=default, title=title, description=doc, pattern=pattern)


def choice(default: str | bool, title: str, doc: str) -> Any:  # noqa: ANN401
    """One of the words of a Literal, or a switch."""
    return Field(default=default, title=title, description=doc)
