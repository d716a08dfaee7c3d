"""A rerun that goes on from a run which closed a loop closes it too, and ends as one from the start does."""

from __future__ import annotations

from contextlib import closing

import pytest

from pipeline.config import Parameters, preset
from pipeline.geometry.poses import Pose3
from pipeline.loop_closure.correction import LOOP
from pipeline.mapper import Mapper
from pipeline.remapping import Basis, Journal, KeptScans, Recalled, Rerun, look_key
from tests.benchmarks.wide_ring import SENSOR, WideRing
from tests.pipeline.remapping.test_resume_point import told

STEMS = preset("stems")
SPACING = 40


def mapper(parameters: Parameters) -> Mapper:
    """Fresh, for the ring."""
    return Mapper(parameters, sensor=SENSOR, T_base_lidar=Pose3.identity(), seed=0)


@pytest.fixture(scope="module")
def ring():
    """A wide ring that is closed: what is kept of it, its basis, and the scans at which a loop was closed."""
    journal, states, whole, closed = Journal(), {}, mapper(STEMS), []
    whole.note = lambda noted: journal.note(noted, STEMS.slam)
    with closing(KeptScans()) as kept:
        for step, _ in WideRing().steps(0):
            if step.index % SPACING == 0:
                states[step.index] = whole.snapshot()
            looked = whole.segment(step)
            kept.put(step, looked, look_key(STEMS))
            if LOOP in whole.process(step, looked).warnings:
                closed.append(step.index)
            if closed and step.index == closed[0] + SPACING:
                break
        states[len(kept)] = whole.snapshot()
        path, notes = whole.path, journal.first(len(kept))
        yield kept, Basis.of(STEMS, notes, states, path, whole.motion), closed


def finished(parameters: Parameters, kept: KeptScans, basis: Basis | None):
    """All that is known at the end, where loops were closed, and in how many scans trees alone were anew; of
    who goes on with both halves of the mapping at once."""
    rerun = Rerun(mapper(parameters), kept, None, basis)
    frames = list(rerun.frames(len(kept)))
    closed = [frame.index for frame in frames if LOOP in getattr(frame, "warnings", ())]
    recalled = sum(frame.index + 1 - frame.first for frame in frames if isinstance(frame, Recalled))
    m = rerun.mapper
    return told((m.snapshot(), m.path, m.height_map)), closed, recalled


@pytest.mark.slow
def test_the_loop_is_closed_again_by_who_goes_on_from_before_it(ring):
    kept, basis, closed = ring
    assert closed
    assert not basis.notes.is_usual.all()
    tried = STEMS.replace({"tracking.hits_to_confirm": 5})
    wanted, where, _ = finished(tried, kept, None)
    given, again, recalled = finished(tried, kept, basis)
    assert given == wanted
    assert where
    assert again == where
    assert SPACING <= recalled < where[0], "the journal is good up to the search for a loop, and no farther"
