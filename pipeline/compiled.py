"""The one place that knows how our own loops are compiled.

Kernels are compiled at their first call and kept on disk beside the source, so that only the first
start on a machine waits for them. `fastmath` stays off: the same input must give the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop over arrays to machine code; it holds no interpreter lock while it runs."""
    kernel: Callable[P, R] = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return kernel
