"""A fixture that opens sources and closes them at the end of a test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from pipeline.io.readers import Source, SourceOptions, open_source

Opened = Callable[..., Source]


@pytest.fixture
def opened() -> Iterator[Opened]:
    """Opens a source, and closes it when the test ends."""
    with ExitStack() as stack:

        def open_and_keep(path: str | Path, options: SourceOptions | None = None) -> Source:
            source = open_source(str(path), options)
            stack.callback(source.close)
            return source

        yield open_and_keep
