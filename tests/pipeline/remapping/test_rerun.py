"""A rerun over kept scans gives the map that mapping with those parameters gives, byte for byte."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest

from app.worker.parallel import AHEAD, looked_ahead
from pipeline.config import FieldSpec, Parameters, field_specs, preset
from pipeline.config.model import Value
from pipeline.errors import StemmapError
from pipeline.front_end import SegmentedScan, segment
from pipeline.geometry.poses import Pose2
from pipeline.io.checkpoints import encode
from pipeline.io.readers import open_source
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps
from pipeline.remapping import KeptScans, Recalled, Rerun, look_key
from pipeline.remapping.cache_key import CLASSIFICATION, STAGES
from pipeline.remapping.packing import HIGHEST
from pipeline.remapping.rerun import one_by_one
from pipeline.types.records import Frame, PoseMeasurement, Scan, Step, Turn

URI = "sim:paper?duration=6&odometry=poor"
SETS = 20


@cache
def run():
    """The steps of a short simulated run, and its source's description."""
    source = open_source(URI)
    return list(steps(source.records())), source.description


def mapper(parameters: Parameters) -> Mapper:
    """Fresh, for the simulated run."""
    d = run()[1]
    return Mapper(parameters, sensor=d.sensor, T_base_lidar=d.T_base_lidar, seed=3)


def put_all(store: KeptScans, parameters: Parameters, parts: list[Step]) -> KeptScans:
    """Keep what these scans show under some parameters."""
    d = run()[1]
    for step in parts:
        store.put(step, segment(step, d.sensor, d.T_base_lidar, parameters), look_key(parameters))
    return store


@pytest.fixture(scope="module")
def kept() -> Iterator[KeptScans]:
    """What the run showed under the preset."""
    with closing(KeptScans()) as store:
        yield put_all(store, preset("forest"), run()[0])


@pytest.fixture
def store() -> Iterator[KeptScans]:
    """Nothing is kept yet."""
    with closing(KeptScans()) as empty:
        yield empty


def told(frame: Frame | Recalled) -> object:
    """All of a frame but the points of its scan and what only their time needs, as bytes."""
    left_out = {"raw", "filtered", "labels", "clearance"}
    return encode(tuple(getattr(frame, f.name) for f in fields(Frame) if f.name not in left_out))


def is_later(name: str) -> bool:
    """Whether a parameter says nothing of what a scan shows."""
    stage, _, field = name.partition(".")
    return field not in CLASSIFICATION if stage == "classification" else stage not in STAGES


def another(spec: FieldSpec, share: float) -> Value:
    """A value that is not the default: the other choice, or away from it by a share of the way to a bound."""
    if spec.kind == "choice":
        return next(c for c in spec.choices if c not in ("graph", spec.default))
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
    """The preset with four of the parameters drawn anew that are asked after the scan was looked at."""
    later = [spec for spec in field_specs() if is_later(spec.name) and spec.kind != "name"]
    while True:
        chosen = [later[int(k)] for k in rng.choice(len(later), 4, replace=False)]
        try:
            return preset("forest").replace(
                {spec.name: another(spec, float(rng.uniform(0.1, 0.5))) for spec in chosen}
            )
        except StemmapError:
            continue  # two of them contradict each other


@pytest.mark.parametrize("seed", range(SETS))
def test_it_gives_what_mapping_gives_to_the_byte(seed, kept):
    parameters = drawn(np.random.default_rng(seed))
    whole, again = mapper(parameters), Rerun(mapper(parameters), kept)
    rerun = again.frames(len(run()[0]))
    for step in run()[0]:
        assert told(whole.process(step)) == told(next(rerun))
    assert encode(whole.path) == encode(again.mapper.path)
    assert encode(whole.height_map) == encode(again.mapper.height_map)


def test_the_key_differs_exactly_where_a_scan_may_show_something_else():
    base = preset("forest")
    for spec in field_specs():
        changed = base.replace({spec.name: another(spec, 0.1)})
        assert changed != base
        assert (look_key(changed) == look_key(base)) == is_later(spec.name), spec.name


def test_what_is_packed_comes_back_whole(store):
    parts, d = run()
    step = replace(
        parts[5],
        warnings=("the odometry jumped", "é"),
        doubt="no odometry",
        slack=(0.25, 0.5),
        turn=Turn(0.1, 0.01),
        measured=PoseMeasurement(
            7, Pose2(1.0, 2.0, 0.1), np.eye(3) * 0.3, 25.0, np.arange(12.0).reshape(3, 4) / 99.0, 1
        ),
    )
    parameters = preset("forest")
    for k in range(12):  # with and without an overview, with and without ground
        looked = segment(replace(step, index=k), d.sensor, d.T_base_lidar, parameters)
        if k == 3:
            looked = replace(looked, heights=None, column_input=None)
        store.put(replace(step, index=k, T_odom_base=None if k == 4 else step.T_odom_base), looked, b"k" * 16)
        again, shown = store.scan(k)
        nothing, over = looked.raw[:0], looked.column_input
        looked = replace(looked, clearance=None)
        if over is not None:
            low = (over.height > 0.0) & (over.height < HIGHEST)
            flat = np.where([True, True, False], over.points, np.float32(0.0))
            looked = replace(looked, column_input=replace(over, points=flat[low], height=over.height[low]))
        assert encode(shown) == encode(
            replace(looked, raw=nothing, filtered=nothing, labels=looked.labels[:0])
        )
        wanted = replace(
            step, index=k, scan=Scan(step.scan.stamp_ns, nothing), T_odom_base=again.T_odom_base,
            roll=0.0, pitch=0.0, tilt_known=False, twist=(0.0, 0.0, 0.0), turn_rate=None, learnt=again.learnt,
        )  # fmt: skip
        assert encode(again) == encode(wanted)
        assert (again.T_odom_base is None) == (k == 4)
    assert store.key_of(11) == b"k" * 16


def test_a_scan_that_shows_nothing_is_kept_too(store):
    parts, d = run()
    step = replace(parts[0], scan=Scan(parts[0].scan.stamp_ns, parts[0].scan.points[:0]))
    looked = segment(step, d.sensor, d.T_base_lidar, preset("forest"))
    store.put(step, looked, b"k" * 16)
    again = store.scan(0)[1]
    assert len(looked.clusters.size) == 0
    assert encode(again.clusters) == encode(looked.clusters)


def test_a_scan_that_is_looked_at_again_takes_the_place_of_those_after_it(store):
    parts = run()[0][:8]
    put_all(store, preset("forest"), parts)
    wider = preset("forest").replace({"clustering.eps": 0.3})
    put_all(store, wider, parts[5:6])
    assert len(store) == 6
    assert [store.key_of(k) == look_key(preset("forest")) for k in range(6)] == [True] * 5 + [False]


@pytest.mark.parametrize(("readings", "ahead"), [(1, one_by_one), (2, looked_ahead)])
def test_what_shows_something_else_is_read_once_more_and_kept_beside(kept, readings, ahead):
    parts = run()[0][:20]
    wider = preset("forest").replace({"clustering.eps": 0.3, "ground.height_max": 2.5})
    whole, read = mapper(wider), []

    def reread() -> Iterator[Step]:
        read.append(True)
        return iter(parts)

    with closing(Rerun(mapper(wider), kept, reread, ahead=ahead)) as again:
        state = again.mapper.snapshot()
        wanted = [told(whole.process(step)) for step in parts]
        for _ in range(readings):  # the second time what was kept beside is good
            again.go_back(0, state)
            assert [told(frame) for frame in again.frames(len(parts))] == wanted
        assert read == [True]
        assert len(again.kept) == len(parts)
        assert again.kept is not kept
    assert len(kept) == len(run()[0])


def test_what_comes_only_once_cannot_be_looked_at_again(kept):
    again = Rerun(mapper(preset("forest").replace({"clustering.eps": 0.3})), kept)
    with pytest.raises(StemmapError, match="cannot be read once more"):
        next(again.frames(3))
    with pytest.raises(StemmapError, match="does not give scan 0 again"):
        next(
            Rerun(mapper(preset("forest").replace({"clustering.eps": 0.3})), kept, lambda: iter(())).frames(3)
        )


def test_what_does_not_fit_is_said_and_what_fitted_stays():
    parts = run()[0]
    with closing(KeptScans(most=400_000)) as store:
        put_all(store, preset("forest"), parts)
        assert 0 < len(store) < len(parts)
        assert store.nbytes <= 400_000
        assert f"from scan {len(store)} on" in store.refusal
        assert [store.scan(k)[0].index for k in range(len(store))] == list(range(len(store)))


def test_a_damaged_scan_is_told(store):
    put_all(store, preset("forest"), run()[0][:3])
    store._file.seek(store.nbytes - 100)
    store._file.write(b"damaged")
    store.scan(0)
    with pytest.raises(StemmapError, match="scan 2 is damaged"):
        store.scan(2)


def test_without_room_on_disk_it_says_so(store):
    put_all(store, preset("forest"), run()[0][:2])
    with open("/dev/full", "rb+", buffering=0) as full:  # noqa: PTH123
        os.dup2(full.fileno(), store._file.fileno())
    put_all(store, preset("forest"), run()[0][2:4])
    assert len(store) == 2
    assert "No space left" in store.refusal


def test_what_could_not_be_read_again_is_not_kept(store, monkeypatch):
    put_all(store, preset("forest"), run()[0][:2])
    monkeypatch.setattr("pipeline.remapping.packing.LARGEST", 1 << 10)
    put_all(store, preset("forest"), run()[0][2:4])
    assert len(store) == 2
    assert "what it showed takes more than" in store.refusal


def test_where_nobody_may_write_nothing_is_kept_and_that_is_said(monkeypatch, tmp_path):
    with closing(KeptScans(tmp_path / "missing")) as elsewhere:
        put_all(elsewhere, preset("forest"), run()[0][:2])
        assert len(elsewhere) == 2

    def refused(**_: object) -> None:
        raise PermissionError

    monkeypatch.setattr("pipeline.remapping.scan_cache.TemporaryFile", refused)
    with closing(KeptScans()) as store:
        put_all(store, preset("forest"), run()[0][:2])
        assert len(store) == 0
        assert "no folder can be written to" in store.refusal


def test_who_looks_ahead_reads_in_order_stops_when_asked_and_tells_faults_in_their_turn():
    read: list[int] = []
    nothing = segment(run()[0][0], run()[1].sensor, run()[1].T_base_lidar, preset("forest"))

    def steps() -> Iterator[Step]:
        for k in range(40):
            read.append(k)
            yield replace(run()[0][0], index=k)

    def fails(step: Step) -> SegmentedScan:
        if step.index == 3:
            raise StemmapError("it cannot be looked at")
        return nothing

    given = looked_ahead(fails, steps())
    assert [next(given)[0].index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(StemmapError, match="cannot be looked at"):
        next(given)
    assert len(read) <= 4 + AHEAD
