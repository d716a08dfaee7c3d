"""A rerun over cached scans gives the same bytes as a first run with the same parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from dataclasses import fields, replace

import numpy as np
import pytest

from app.worker.remap import AHEAD, segment_ahead
from pipeline.config import FieldSpec, Parameters, field_specs, preset
from pipeline.config.model import Value
from pipeline.errors import StemmapError
from pipeline.front_end import SegmentedScan
from pipeline.io.checkpoints import encode
from pipeline.map_faults import EMPTY
from pipeline.remapping.rerun import (
    SEGMENTATION_CLASSIFICATION,
    SEGMENTATION_STAGES,
    Rerun,
    ScanCache,
    ScanCaches,
    segmentation_key,
)
from pipeline.types.records import Frame, Step
from tests.pipeline.remapping.mapped import BASE, fill, frames, mapper, run

SETS = 6
WIDER = BASE.replace({"clustering.eps": 0.3, "ground.height_max": 2.5})


def content(frame: Frame) -> object:
    """All of a frame as bytes, without the points of its scan and what needs them."""
    left_out = {"raw", "filtered", "labels", "clearance"}
    return encode(tuple(getattr(frame, f.name) for f in fields(Frame) if f.name not in left_out))


def is_later(name: str) -> bool:
    """Whether a parameter does not change the segmentation of a scan."""
    stage, _, field = name.partition(".")
    if name in ("tracking.breast_height", "detection.radius_min", "detection.radius_max"):
        return False  # the height of the centres of clusters, and the radius of trunks in them
    return (
        field not in SEGMENTATION_CLASSIFICATION
        if stage == "classification"
        else stage not in SEGMENTATION_STAGES
    )


def another(spec: FieldSpec, share: float) -> Value:
    """A value that is not the default: the other choice, or away from it by a share of the way to a bound."""
    if spec.kind == "choice":
        return next(c for c in spec.choices if c != spec.default)
    if spec.kind == "bool":
        return not spec.default
    if spec.kind == "name":
        return "0" * 16
    assert spec.minimum is not None
    assert spec.maximum is not None
    default = float(spec.default)
    bound, most = (spec.maximum if default < spec.maximum else spec.minimum), abs(default) + 1.0
    value = default + share * min(max(bound - default, -most), most)
    if spec.kind == "int":
        return math.ceil(value) if bound > default else math.floor(value)
    return value


def drawn(rng: np.random.Generator) -> Parameters:
    """The preset with random values of four parameters that do not change the segmentation."""
    later = [spec for spec in field_specs() if is_later(spec.name) and spec.kind != "name"]
    while True:
        chosen = [later[int(k)] for k in rng.choice(len(later), 4, replace=False)]
        try:
            return preset("forest").replace(
                {spec.name: another(spec, float(rng.uniform(0.1, 0.5))) for spec in chosen}
            )
        except StemmapError:
            continue  # two of them contradict each other


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("seed", range(SETS))
def test_a_rerun_gives_the_bytes_of_a_first_run(seed, known):
    parameters = drawn(np.random.default_rng(seed))
    first, again = mapper(parameters), Rerun(mapper(parameters), known[0])
    for step in run()[0]:
        assert content(first.process(step)) == content(again.map_next())
    assert encode(first.path) == encode(again.mapper.path)
    assert encode(first.height_map) == encode(again.mapper.height_map)


def test_the_key_differs_exactly_where_the_segmentation_may_differ():
    for spec in field_specs():
        changed = BASE.replace({spec.name: another(spec, 0.1)})
        assert changed != BASE
        assert (segmentation_key(changed) == segmentation_key(BASE)) == is_later(spec.name), spec.name


def test_scans_that_are_not_cached_are_read_again_once_and_cached():
    parts, read = run()[0][:20], []

    def reread(index: int) -> Iterator[Step]:
        read.append(index)
        return iter(parts[index:])

    first = mapper(WIDER)
    wanted = [content(first.process(step)) for step in parts]
    with closing(ScanCaches()) as caches:
        again = Rerun(mapper(WIDER), caches.of(WIDER), reread)
        state = again.mapper.snapshot()
        for _ in range(2):
            again.go_back(0, state)
            assert [content(frame) for frame in frames(again, len(parts))] == wanted
        again.close()
        assert read == [0]
        assert caches.of(WIDER).has_all(len(parts))


def test_scans_of_a_live_run_cannot_be_read_again():
    with closing(ScanCaches()) as caches:
        with pytest.raises(StemmapError, match="cannot be read again"):
            Rerun(mapper(WIDER), caches.of(WIDER)).map_next()
        with pytest.raises(StemmapError, match="does not give scan 0 again"):
            Rerun(mapper(WIDER), caches.of(WIDER), lambda _: iter(())).map_next()


def test_segment_ahead_keeps_the_order_stops_when_asked_and_raises_errors_in_turn():
    read: list[int] = []
    nothing = mapper(preset("forest")).segment(run()[0][0])

    def steps() -> Iterator[Step]:
        for k in range(40):
            read.append(k)
            yield replace(run()[0][0], index=k)

    def fails(step: Step) -> SegmentedScan:
        if step.index == 3:
            raise StemmapError("this scan fails")
        return nothing

    given = segment_ahead(fails, steps())
    assert [next(given)[0].index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(StemmapError, match="this scan fails"):
        next(given)
    assert len(read) <= 4 + AHEAD


def test_scans_without_their_points_make_no_map_doubtful():
    """A seek maps whole steps with cached scans, which have no points."""
    parts = run()[0]
    one, other = mapper(BASE), mapper(BASE)
    with closing(fill(ScanCache(), BASE, parts)) as cache:
        for step in parts:
            cached = cache.read(step.index, step.scan.stamp_ns)
            assert cached is not None
            frame = one.process(step, cached[1])
            assert content(frame) == content(other.process(step)), step.index
            assert not any(EMPTY in text for text in frame.warnings)
