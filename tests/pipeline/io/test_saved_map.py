"""Saved maps: a mapper that continues from one gives the same bytes, and damaged files are refused."""

from __future__ import annotations

import io
import json
import zipfile
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.classification import PackedVoxelMap
from pipeline.classification.voxel_map import VoxelMap
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2
from pipeline.io.checkpoints import decode, encode, read_archive, write_archive
from pipeline.io.checkpoints.saved_map import SavedMap
from pipeline.slam.frame_uncertainty import FrameUncertainty
from pipeline.slam.keyframe_graph import LoopEdge
from pipeline.types.records import Float, Float32, Int
from tests.pipeline.test_mapper import as_bytes, fed, mapper, run


@cache
def saved():
    """The map after twelve scans, and the rest of the run from there at once."""
    m = mapper()
    fed(m, run()[0][:12])
    return SavedMap.of(m), fed(m, run()[0][12:]), as_bytes(m.path)


def through_a_file(state):
    """Written and read."""
    tree, blob = read_archive(write_archive(*encode(state)), "a file")
    return decode(SavedMap, tree, blob)


def test_from_a_saved_map_another_mapper_goes_on_to_the_same_bytes():
    state, wanted, path = saved()
    read = through_a_file(state)
    m = mapper()
    m.load(read.state(), read.stamp_ns, read.sigma_xy, read.motion)
    assert len(m.snapshot().slam.graph.keyframes) == len(state.slam.graph.keyframes) > 0
    assert fed(m, run()[0][12:]) == wanted
    assert as_bytes(m.path) == path


def test_the_file_has_the_same_bytes_each_time():
    state, _, _ = saved()
    one = write_archive(*encode(state))
    assert write_archive(*encode(through_a_file(state))) == one


def test_a_small_file_that_unpacks_to_gigabytes_is_refused_before_it_does():
    large = io.BytesIO()
    with zipfile.ZipFile(large, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("tree.json", "{}")
        with archive.open("arrays.bin", "w", force_zip64=True) as file:
            for _ in range(80):
                file.write(bytes(1 << 20))
    with pytest.raises(StemmapError, match=r"arrays\.bin declares 83886080 bytes"):
        read_archive(large.getvalue(), "a file")


def test_a_placed_robot_stands_where_it_was_put():
    state, _, _ = saved()
    m = mapper()
    m.load(state.state(), state.stamp_ns, state.sigma_xy, state.motion)
    m.place(12, Pose2(2.0, -1.0, 0.5), np.diag([0.01, 0.01, 0.001]) ** 2)
    frame = m.process(replace(run()[0][12], T_odom_base=Pose2(70.0, 50.0, 3.0)))
    told = frame.estimate.particles
    assert len(m.path.x) == len(m.motion) == 13
    assert m.snapshot().placed == 12
    again = through_a_file(SavedMap.of(m))
    assert (again.placed, again.motion.tobytes()) == (12, m.motion.tobytes())
    assert np.ptp(told[:, 0]) > 0.0
    np.testing.assert_allclose(told.mean(axis=0), [2.0, -1.0, 0.5], atol=0.5)


# --- what is not a saved map ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "changed",
    [
        FrameUncertainty(serial=np.arange(5)),
        FrameUncertainty(np.array([3, 1]), np.arange(2), np.zeros((2, 3)), np.zeros((2, 3, 3))),
        FrameUncertainty(np.arange(2), np.array([0, 10**6]), np.zeros((2, 3)), np.zeros((2, 3, 3))),
        FrameUncertainty(hidden=np.full((3, 3), np.nan)),
        FrameUncertainty(at=np.zeros(2)),
    ],
    ids=[
        "marks without poses",
        "marks out of order",
        "a mark of no scan",
        "no number",
        "a pose of two numbers",
    ],
)
def test_a_frame_that_compiled_code_would_read_beyond_is_refused(changed):
    state, _, _ = saved()
    with pytest.raises(ValueError, match=r"(?i)frame|finite"):
        replace(state, slam=replace(state.slam, frame=changed)).state()


def test_a_tree_changed_anywhere_is_refused_or_read():
    """No change of a number may crash, whatever it means."""
    state, _, _ = saved()
    tree, blob = encode(state)
    rng = np.random.default_rng(0)
    for _ in range(25):
        text = json.dumps(tree)
        digits = [k for k, letter in enumerate(text) if letter.isdigit()]
        at = digits[int(rng.integers(len(digits)))]
        changed = json.loads(text[:at] + str(rng.integers(1, 10)) + text[at + 1 :])
        with suppress(ValueError):
            decode(SavedMap, changed, blob).state()


@pytest.mark.parametrize(
    "data",
    [b"", b"PK", b"no zip at all", write_archive({}, b""), write_archive([1, 2], b"x" * 64)],
    ids=["empty", "cut", "text", "no parts", "a row"],
)
def test_what_is_no_saved_map_is_refused(data):
    with pytest.raises((StemmapError, ValueError)):
        decode(SavedMap, *read_archive(data, "a file"))


def test_a_cut_file_is_refused():
    data = write_archive(*encode(saved()[0]))
    for length in range(0, len(data), len(data) // 5):
        with pytest.raises(StemmapError, match="damaged"):
            read_archive(data[:length], "a file")


def test_a_byte_that_went_wrong_anywhere_is_one_error_for_people():
    whole = write_archive(*encode(saved()[0]))
    rng = np.random.default_rng(3)
    for at in rng.integers(0, len(whole), 60).tolist():
        data = whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :]
        with suppress(StemmapError, ValueError):
            decode(SavedMap, *read_archive(data, "a file"))


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("sensor_z", 10**400),
        ("tile", {"dtype": "<i8", "shape": [], "at": 0}),
        ("tile", {"dtype": "<i8", "shape": [0, 1 << 70], "at": 0}),
    ],
)
def test_numbers_and_shapes_that_no_array_has_are_refused(part, value):
    tree, blob = encode(saved()[0])
    tree["ground"][part] = value
    with pytest.raises(ValueError, match=r"."):
        decode(SavedMap, tree, blob).state()


def _with(state, **changes: Any):
    return replace(state, slam=replace(state.slam, **changes))


def _with_graph(state, **changes: Any):
    return _with(state, graph=replace(state.slam.graph, **changes))


def _with_keyframe(state, **changes: Any):
    first, *rest = state.slam.graph.keyframes
    return _with_graph(state, keyframes=(replace(first, **changes), *rest))


def _with_places(state, **changes: Any):
    return _with(state, places=replace(state.slam.places, **changes))


def _with_maps(state, **changes: Any):
    return _with(state, maps=state.slam.maps._replace(**changes))


@pytest.mark.parametrize(
    "change",
    [
        lambda s: replace(s, stamp_ns=s.stamp_ns[:-1]),
        lambda s: replace(s, motion=s.motion[:-1]),
        lambda s: replace(s, motion=s.motion + np.nan),
        lambda s: replace(s, placed=-1),
        lambda s: replace(s, placed=13),
        lambda s: replace(s, next_number=0),
        lambda s: _with_maps(s, hits=s.slam.maps.hits[:-1]),
        lambda s: _with_maps(s, block=s.slam.maps.block + 1),
        lambda s: _with_maps(s, owners=s.slam.maps.owners + 1),
        lambda s: _with(s, best=100),
        lambda s: _with_maps(s, mean=s.slam.maps.mean[:, :, :1]),
        lambda s: _with(s, pose=s.slam.pose * np.nan),
        lambda s: _with_maps(s, mean=s.slam.maps.mean + np.nan),
        lambda s: _with_graph(s, pose=s.slam.graph.pose[:-1]),
        lambda s: _with_graph(s, solved=-1),
        lambda s: _with_places(s, inactive=np.ones(100, np.bool_)),
        lambda s: _with_places(s, birth=s.slam.places.birth[:-1]),
        lambda s: _with_places(s, seen=s.slam.places.seen * np.nan),
        lambda s: _with_keyframe(s, scan=-1),
        lambda s: _with_keyframe(s, birth=s.slam.graph.keyframes[0].birth[:-1]),
        lambda s: _with_keyframe(s, R=-s.slam.graph.keyframes[0].R),
        lambda s: _with_keyframe(s, motion=np.full(3, np.nan)),
        lambda s: _with_keyframe(s, covariance=-np.eye(3)),
        lambda s: _with_graph(s, loops=(LoopEdge((0, 1 << 40), np.zeros(3), np.eye(3)),)),
        lambda s: replace(s, tracks=replace(s.tracks, x=s.tracks.x + np.nan)),
        lambda s: replace(s, stamp_ns=s.stamp_ns[:, None]),
        lambda s: replace(s, columns=replace(s.columns, axis=s.columns.axis[:, :3])),
        lambda s: replace(s, memory=replace(s.memory, room=3)),
        lambda s: replace(s, memory=replace(s.memory, room=1 << 40)),
        lambda s: replace(s, memory=replace(s.memory, key=s.memory.key * 0)),
        lambda s: replace(s, memory=replace(s.memory, tile_judged=s.memory.tile_judged[:-1])),
    ],
)
def test_parts_that_do_not_fit_are_refused(change):
    with pytest.raises(ValueError, match=r"."):
        change(saved()[0]).state()


# --- the parts ------------------------------------------------------------------------------------


@dataclass
class Inner:
    """One of the parts."""

    a: int
    b: float
    c: tuple[int, str]


@dataclass
class Outer:
    """All kinds of parts."""

    x: Float
    y: Float32
    z: Int | None
    parts: tuple[Inner, ...]
    word: str
    flag: bool
    many: list[float]


@given(
    st.lists(st.floats(width=64), max_size=5),
    st.lists(st.tuples(st.integers(-(2**62), 2**62), st.floats(), st.text()), max_size=3),
    st.booleans(),
)
def test_every_record_comes_back_bit_by_bit(numbers, parts, flag):
    inner = tuple(Inner(a, b, (a, c)) for a, b, c in parts)
    z = np.arange(3) if flag else None
    array = np.array(numbers, np.float64)
    outer = Outer(array, np.zeros((2, 0, 3), np.float32), z, inner, "ö\n", flag, array.tolist())
    back = decode(Outer, *read_archive(write_archive(*encode(outer)), ""))
    assert repr(back) == repr(outer)
    assert back.x.tobytes() == outer.x.tobytes()
    assert back.y.shape == outer.y.shape


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_a_memory_comes_back_bit_by_bit(seed, scans):
    rng = np.random.default_rng(seed)
    memory = VoxelMap.empty(1 << 6, 1 << 2)
    for k in range(scans):
        points = rng.uniform([-15, -15, 0], [15, 15, 5], (60, 3)).astype(np.float32)
        memory.add(points, k, 1 << 7)
        memory.due_tiles(1.1)
    back = PackedVoxelMap.of(memory).unpacked()
    for f in fields(VoxelMap):
        one: Any = getattr(memory, f.name)
        other: Any = getattr(back, f.name)
        if isinstance(one, np.ndarray):
            assert one.shape == other.shape, f.name
            used = memory.tiles if f.name.startswith("tile_") and "slot" not in f.name else memory.used
            part = slice(None) if "slot" in f.name else slice(used)
            assert one[part].tobytes() == other[part].tobytes(), f.name
        else:
            assert one == other, f.name


@dataclass(frozen=True)
class _Column:
    values: Int


@pytest.mark.parametrize("planes", [False, True])
def test_arrays_in_another_byte_order_are_converted(planes):
    values = np.array([1, -2, 3], np.dtype(np.int64).newbyteorder(">"))
    tree, blob = encode(_Column(values), planes=planes)
    np.testing.assert_array_equal(decode(_Column, tree, blob, planes=planes).values, [1, -2, 3])
