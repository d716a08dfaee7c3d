"""Phrases that several rooms show to users."""

from __future__ import annotations

from pipeline.config import PRESETS, Parameters, preset
from pipeline.config.model import Value

COMPILING = "compiling for this machine; it takes some minutes the first time, less for a new kind of source"


def count(n: int, one: str, many: str = "") -> str:
    """A number with its noun: "1 scan", "1,200 scans", "2 spans of scans".

    Args:
        one: The noun; many: its plural where that is not one with an s.
    """
    return f"{n:,} {one if n == 1 else many or f'{one}s'}"


MOST = 6  # values that a line names


def changed_values(name: str, parameters: Parameters) -> dict[str, Value]:
    """The values that differ from the preset of this name, by dotted name; all where there is none."""
    return parameters.changes_from(preset(name)) if name in PRESETS else dict(parameters.flat())


def preset_words(name: str, parameters: Parameters) -> str:
    """For people: "preset forest", or "preset forest with clustering.eps = 0.2"."""
    changed = changed_values(name, parameters)
    if not changed:
        return f"preset {name}"
    told = [f"{key} = {value}" for key, value in changed.items()]
    rest = f" and {len(told) - MOST} more" if len(told) > MOST else ""
    return f"preset {name} with {', '.join(told[:MOST])}{rest}"
