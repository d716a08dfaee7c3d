"""What is asked of something that may still be under way."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

A = ParamSpec("A")
R = TypeVar("R")


def after(caught_up: Callable[[], None], asked: Callable[A, R]) -> Callable[A, R]:
    """The same question, for who has to wait first: `caught_up` returns once it may be asked."""

    def later(*given: A.args, **named: A.kwargs) -> R:
        caught_up()
        return asked(*given, **named)

    return later
