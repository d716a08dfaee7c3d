"""Interface by which a caller measures the stages. The pipeline itself reads no clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

StageTimer = Callable[[str], AbstractContextManager[None]]
"""Returns the context that encloses one stage, given the name of the stage."""


def no_timer(_stage: str) -> AbstractContextManager[None]:
    """Measure nothing: the default where the caller needs no times."""
    return nullcontext()
