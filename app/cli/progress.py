"""What a person waits for at a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from app.common.text import COMPILING


@contextmanager
def compiling_is_said() -> Iterator[None]:
    """Inside, the first kernel that has to be compiled is said on stderr, above a progress bar."""
    from tqdm import tqdm

    from pipeline.jit import on_compiling

    said = False

    def say() -> None:
        nonlocal said
        if not said:
            said = True
            tqdm.write(COMPILING, file=sys.stderr)
            sys.stderr.flush()

    with on_compiling(say):
        yield
