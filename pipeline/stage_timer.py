"""Interface for measuring the stages of the pipeline. The pipeline itself reads no clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

StageTimer = Callable[[str], AbstractContextManager[None]]
"""Function of the name of a stage that returns the context in which the stage runs."""


def no_timer(_stage: str) -> AbstractContextManager[None]:
    """Return a context that measures nothing, for any name of a stage: the default for callers that need no
    times."""
    return nullcontext()
