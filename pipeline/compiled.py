"""The one place that knows how our own loops are compiled.

Kernels are compiled at their first call and kept on disk beside the source, so that only the first
start on a machine waits for them. `fastmath` stays off: the same input must give the same bytes. Only
where a kernel does nothing but add up over an array, its terms may be added in another order.
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


def compiled_sums(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop that adds up over arrays so that vector registers are used, which is several times
    faster. The order of the terms is set when it is compiled: runs on one kind of processor agree in
    every byte, two kinds may differ in the last bit, as with the library's products of matrices."""
    kernel: Callable[P, R] = numba.njit(
        cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz"}
    )(function)
    return kernel
