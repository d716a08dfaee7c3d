"""The run of `mapped` with all that is kept of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest

from pipeline.remapping import Basis, Journal, KeptScans, look_key
from tests.pipeline.remapping.mapped import BASE, SPACING, mapper, run


@pytest.fixture(scope="session")
def known() -> Iterator[tuple[KeptScans, Basis]]:
    """The run mapped with the preset, and what is kept of that."""
    journal, states, whole = Journal(), {}, mapper(BASE)
    whole.note = lambda noted: journal.note(noted, BASE.slam)
    with closing(KeptScans()) as kept:
        for step in run()[0]:
            if step.index % SPACING == 0:
                states[step.index] = whole.snapshot()
            looked = whole.segment(step)
            kept.put(step, looked, look_key(BASE))
            whole.process(step, looked)
        states[len(kept)] = whole.snapshot()
        path = whole.path
        notes = journal.first(len(kept))
        assert len(notes) == len(kept)
        yield kept, Basis.of(BASE, notes, states, path, whole.motion)
