"""The parameters that a recorded run was mapped with: a set for the whole run replaces those before it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from app.worker.run import recorded_parameters
from pipeline.config import Parameters
from pipeline.io.readers.base import Revision
from tests.app.fakes import FakeSource

SETS = {
    name: Parameters().replace({"clustering.eps": eps}) for name, eps in (("a", 0.1), ("b", 0.2), ("c", 0.3))
}


@pytest.mark.parametrize(
    ("told", "meant"),
    [
        ([(0, "a"), (50, "b")], [(0, "a"), (50, "b")]),
        ([(0, "a"), (50, "b"), (0, "b")], [(0, "b")]),
        ([(0, "a"), (50, "b"), (0, "b"), (80, "c")], [(0, "b"), (80, "c")]),
        ([(0, "a"), (50, "b"), (50, "c")], [(0, "a"), (50, "c")]),
    ],
)
def test_each_scan_is_mapped_with_what_was_in_force_at_the_end(told, meant):
    revisions = tuple(
        Revision(revision=k, from_scan=first, values=SETS[name].model_dump())
        for k, (first, name) in enumerate(told)
    )
    known = replace(FakeSource(3).description, revisions=revisions)
    assert recorded_parameters(known) == tuple((first, SETS[name]) for first, name in meant)
