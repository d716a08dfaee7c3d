"""Two halves of the mapping on two cores give what one after the other gives, whatever happens on the way."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest

from app.worker.abreast import AHEAD, abreast
from pipeline.errors import StemmapError
from pipeline.front_end import Looked
from pipeline.mapper import LOOP
from pipeline.remapping import Rerun
from pipeline.remapping.rerun import in_turn
from pipeline.types.records import Step
from tests.pipeline.loop_closure.test_kidnapped_robot import kidnapped
from tests.pipeline.loop_closure.test_kidnapped_robot import mapper as driven
from tests.pipeline.remapping.mapped import BASE, mapper, run
from tests.pipeline.remapping.test_rerun import told
from tests.pipeline.test_mapper import as_bytes


@cache
def shown() -> list[tuple[Step, Looked]]:
    """What a short run's scans show."""
    return [(step, mapper(BASE).look(step)) for step in run()[0][:30]]


@pytest.fixture(autouse=True)
def _nobody_is_left():
    yield
    assert not any(thread.name.startswith("locate") for thread in threading.enumerate())


def test_a_robot_that_is_lost_and_found_is_mapped_as_in_turn():
    before, after = kidnapped()
    scans = [(step, driven().look(step)) for step in (*before, *after)]
    one, two = driven(), driven()
    wanted, given = list(in_turn(one, iter(scans))), list(abreast(two, iter(scans)))
    assert any("is lost" in word for frame in wanted for word in frame.warnings)
    assert any("found again" in word for frame in wanted for word in frame.warnings)
    assert [told(frame) for frame in given] == [told(frame) for frame in wanted]
    assert as_bytes(two.snapshot()) == as_bytes(one.snapshot())
    assert as_bytes(two.path) == as_bytes(one.path)


def test_no_scan_is_located_while_a_loop_is_looked_for(monkeypatch):
    monkeypatch.setattr("pipeline.loop_closure.detection.is_due", lambda index, _: index % 4 == 0)
    sought: list[int] = []
    monkeypatch.setattr(
        "pipeline.loop_closure.detection.find_loop", lambda run, _: sought.append(len(run.path))
    )
    m = mapper(BASE)
    located, locate = [], m.locate

    def listed(step, looked, caught_up):
        located.append((step.index, len(sought)))
        return locate(step, looked, caught_up)

    monkeypatch.setattr(m, "locate", listed)
    frames = list(abreast(m, iter(shown()[:13])))
    assert sought == [1, 5, 9, 13], "the path ended at the scan that asked"
    assert located == [(index, (index + 3) // 4) for index in range(13)]
    assert not any(LOOP in frame.warnings for frame in frames)


def test_what_fails_fails_in_its_turn():
    def cut() -> Iterator[tuple[Step, Looked]]:
        yield from shown()[:6]
        raise StemmapError("what was kept is damaged")

    frames = abreast(mapper(BASE), cut())
    assert [next(frames).index for _ in range(6)] == list(range(6))
    with pytest.raises(StemmapError, match="is damaged"):
        next(frames)


@pytest.mark.parametrize("half", ["locate", "map"])
def test_a_fault_in_either_half_is_told_and_nobody_waits_for_ever(half, monkeypatch):
    m = mapper(BASE)
    whole = getattr(m, half)

    def broken(*given: Any) -> Any:
        step = getattr(given[0], "step", given[0])
        if step.index == 11:  # the next scan asks for the whole map
            raise ZeroDivisionError
        return whole(*given)

    monkeypatch.setattr(m, half, broken)
    frames = abreast(m, iter(shown()))
    assert [next(frames).index for _ in range(11)] == list(range(11))
    with pytest.raises(ZeroDivisionError):
        next(frames)


def test_who_stops_in_the_middle_leaves_a_whole_mapper(known):
    kept, _ = known
    tried = BASE.replace({"detection.e_max": 12.0})
    left, whole = Rerun(mapper(tried), kept, abreast=abreast), Rerun(mapper(tried), kept)
    frames = left.frames(len(kept))
    for _ in range(5):
        next(frames)
    frames.close()
    assert 5 <= left.done <= 6 + AHEAD
    for _ in whole.frames(left.done):
        pass
    assert as_bytes(left.state()) == as_bytes(whole.state())
    given = [told(frame) for frame in left.frames(len(kept))]
    assert given == [told(frame) for frame in whole.frames(len(kept))]
    assert left.mapper.snapshot().path_length == len(kept)
