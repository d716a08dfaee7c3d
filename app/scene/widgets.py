"""What all widgets of the panel share."""

from __future__ import annotations

from typing import Any


def set_value(widget: Any, value: float | int | bool | str) -> None:  # noqa: ANN401
    """Set a widget from code. (mypy takes viser's generic setter for a property without one.)"""
    widget.value = value
