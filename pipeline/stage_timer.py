"""How somebody outside measures the stages: the pipeline itself knows no clock."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

Watch = Callable[[str], AbstractContextManager[None]]


def no_watch(_stage: str) -> AbstractContextManager[None]:
    """Measures nothing; stands in where nobody asks for times."""
    return nullcontext()
