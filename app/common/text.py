"""Text that several packages show to users.

`pipeline.config` is imported inside the functions, because `--help` imports this module and has to answer at
once.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.config import Parameters
    from pipeline.config.model import Value


COMPILING = (
    "compiling for this machine; this takes minutes the first time, and less for each new kind of source"
)


def count(n: int, one: str, many: str = "") -> str:
    """Return a number with its noun, for example "1 scan" or "1,200 scans".

    Args:
        n: Number.
        one: Singular of the noun.
        many: Plural, if it is not the singular with an s.
    """
    return f"{n:,} {one if n == 1 else many or f'{one}s'}"


MOST = 6  # maximum number of values in a line


def changed_values(name: str, parameters: Parameters) -> dict[str, Value]:
    """Return a dict from dotted names to the values that differ from a preset; to all values if the preset
    does not exist.

    Args:
        name: Name of the preset.
        parameters: The values.
    """
    from pipeline.config import PRESETS, preset

    return parameters.changes_from(preset(name)) if name in PRESETS else dict(parameters.flat())


def preset_words(name: str, parameters: Parameters) -> str:
    """Return a description such as "preset forest" or "preset forest with clustering.eps = 0.2", with at most
    six values and the number of the others.

    Args:
        name: Name of the preset.
        parameters: Parameters; those of `changed_values` are named.
    """
    changed = changed_values(name, parameters)
    if not changed:
        return f"preset {name}"
    values = [f"{key} = {value}" for key, value in changed.items()]
    rest = f" and {len(values) - MOST} more" if len(values) > MOST else ""
    return f"preset {name} with {', '.join(values[:MOST])}{rest}"


def version() -> str:
    """Return the version, for example "0.1.0"."""
    from importlib.metadata import version as of

    return of("stemmap")


@cache
def code_digest() -> str:
    """Return the version and the first 16 hex digits of a SHA-256 of the sources (.py and .json) of the
    pipeline, as "version+digest". It is computed once per process."""
    import pipeline

    assert pipeline.__file__ is not None  # noqa: S101 - the package has an __init__.py
    folder = Path(pipeline.__file__).parent
    state = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        if file.suffix in (".py", ".json"):
            state.update(f"{file.relative_to(folder).as_posix()}\0".encode() + file.read_bytes() + b"\0")
    return f"{version()}+{state.hexdigest()[:16]}"
