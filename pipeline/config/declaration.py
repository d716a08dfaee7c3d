"""Helpers with which a stage declares its parameters."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class Stage(BaseModel):
    """Parameters of one stage: immutable, strictly typed, without unknown names, NaN or infinity.

    The docstring of a parameter explains it in one sentence, for the help text and docs/parameters.md.
    """

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )

    @classmethod
    def title(cls) -> str:
        """Return the title of the stage: its docstring up to the first colon, without spaces at its ends."""
        return (cls.__doc__ or cls.__name__).partition(":")[0].strip()


def number(
    default: float,
    title: str,
    unit: str,
    low: float,
    high: float,
    step: float,
    shown: tuple[float, float] | None = None,
    *,
    main: bool = False,
) -> Any:  # noqa: ANN401 - pydantic's Field is the default of a field of any type
    """Return the declaration of a floating-point parameter: pydantic's Field with the bounds, and with unit,
    step, `shown` and `main` in the JSON schema.

    Args:
        default: Value in the preset `forest`.
        title: Label of the slider.
        unit: Unit symbol; empty if dimensionless.
        low, high: Bounds, inclusive.
        step: Increment of the slider by a key.
        shown: Range of the slider; not compared with the bounds. By default, from a tenth to ten times of the
            default within the bounds if the default is positive and `low` not negative, else the bounds.
        main: Whether the parameter has a slider next to the 3D scene.
    """
    if shown is None:
        shown = (max(low, default / 10), min(high, default * 10)) if default > 0.0 <= low else (low, high)
    extra: dict[str, Any] = {"unit": unit, "step": step, "shown": list(shown), "main": main}
    return Field(default=default, title=title, ge=low, le=high, json_schema_extra=extra)


def count(default: int, title: str, unit: str, low: int, high: int, *, main: bool = False) -> Any:  # noqa: ANN401
    """Return the declaration of an integer parameter, as `number` with the step 1 and the default range of
    the slider, whose ends need not be whole numbers.

    Args:
        default: Value in the preset `forest`.
        title: Label of the slider.
        unit: Unit symbol; empty if dimensionless.
        low, high: Bounds, inclusive.
        main: Whether the parameter has a slider next to the 3D scene.
    """
    return number(default, title, unit, low, high, 1, main=main)


def name(default: str, title: str, pattern: str) -> Any:  # noqa: ANN401
    """Return the declaration of a parameter that holds a name.

    Args:
        default: Value in the preset `forest`.
        title: Label on the page.
        pattern: Regular expression of the valid names.
    """
    return Field(default=default, title=title, pattern=pattern)


def choice(default: str | bool, title: str) -> Any:  # noqa: ANN401
    """Return the declaration of a parameter of type bool or Literal, which lists the valid words; the type is
    that of the annotation.

    Args:
        default: Value in the preset `forest`.
        title: Label on the page.
    """
    return Field(default=default, title=title)
