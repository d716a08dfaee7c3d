"""What is sent arrives unchanged; what does not fit is refused before it takes memory."""

from __future__ import annotations

import io
from contextlib import suppress
from dataclasses import fields, is_dataclass
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from app.worker.protocol import (
    FASTEST,
    LARGEST_MESSAGE,
    LENGTH_BYTES,
    LONGEST_S,
    MOST_SCANS,
    Advance,
    Answer,
    AskCluster,
    AskSection,
    AskTree,
    AskTreePicture,
    Open,
    Opened,
    Play,
    Report,
    Seek,
    SetParameters,
    SetSpeed,
    Shown,
    Status,
    WireError,
    from_worker,
    to_worker,
)
from pipeline.config import Parameters
from pipeline.types.records import Path, TruthTrees
from tests.app.explain.stories import cluster_story, tree_story
from tests.app.fakes import frame, path, truth_trees


def assert_same(a: Any, b: Any) -> None:
    """Equal in all fields, with the arrays' types and shapes."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif is_dataclass(a) and not isinstance(a, type):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, msgspec.Struct):
        for name in a.__struct_fields__:
            assert_same(getattr(a, name), getattr(b, name))
    else:
        assert a == b or (isinstance(a, float) and np.isnan([a, b]).all())


def body(message: Any) -> bytes:
    packed = from_worker().encode(message)
    assert int.from_bytes(packed[:LENGTH_BYTES], "little") == len(packed) - LENGTH_BYTES
    return packed[LENGTH_BYTES:]


finite = st.floats(allow_nan=False, width=64)
columns = st.integers(0, 40).flatmap(
    lambda n: st.tuples(
        hnp.arrays(np.int64, n), *(hnp.arrays(np.float64, n, elements=st.floats()) for _ in range(4))
    )
)


@given(columns, st.integers(0, 2**31), finite)
def test_a_shown_picture_survives_the_journey(rows: Any, start: int, time_s: float) -> None:
    shown = Shown(3, time_s, frame(7, 12345, x=1.5, n_trees=3, warnings=("odd",)), start, Path(*rows))
    assert_same(from_worker().decode(body(shown)), shown)


@given(hnp.arrays(np.float64, st.integers(0, 9)))
def test_truth_and_status_survive_the_journey(x: Any) -> None:
    truth = TruthTrees(x=x, y=-x, dbh=x, kind=tuple("tree" for _ in x))
    opened = Opened("sim:stand", "simulated", "forest", None, 1.5, truth)
    assert_same(from_worker().decode(body(opened)), opened)
    report = Report(Status("playing", stage_ms={"slam": 0.5}, warnings=["one"], scans=None))
    assert from_worker().decode(body(report)) == report


def test_stories_survive_the_journey() -> None:
    nan = float("nan")
    cluster = Answer(3, cluster=cluster_story(eccentricity=float("inf"), tree=None))
    assert from_worker().decode(body(cluster)) == cluster
    tree = Answer(4, tree=tree_story(7))
    assert from_worker().decode(body(tree)) == tree
    unmeasured = from_worker().decode(body(Answer(5, tree=msgspec.structs.replace(tree_story(7), dbh=nan))))
    assert isinstance(unmeasured, Answer)
    assert unmeasured.tree is not None
    assert np.isnan(unmeasured.tree.dbh)


@given(
    st.one_of(
        st.builds(Play),
        st.builds(AskCluster, st.integers(0, 2**40), st.integers(0, 99), st.integers(0, 99), st.just(1)),
        st.builds(AskTree, st.integers(0, 2**40), st.integers(0, 99), st.integers(0, 99)),
        st.builds(AskTreePicture, st.integers(0, 2**40), st.integers(0, 99), st.integers(0, 99)),
        st.builds(AskSection, st.integers(0, 2**40), st.integers(0, 99)),
        st.builds(Advance, st.integers(-MOST_SCANS, MOST_SCANS)),
        st.builds(Seek, st.floats(0.0, LONGEST_S)),
        st.builds(SetSpeed, st.floats(0.0, FASTEST)),
        st.builds(Open, st.text(), st.sampled_from(["auto", "static"]), st.integers(0, 2**63 - 1)),
        st.just(SetParameters(Parameters().model_dump(), 4)),
    )
)
def test_commands_survive_the_journey(command: Any) -> None:
    stream = io.BytesIO(to_worker().encode(command) + to_worker().encode(Play()))
    channel = to_worker()
    assert channel.read(stream) == command
    assert channel.read(stream) == Play()
    assert channel.read(stream) is None


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_a_wire_error(content: bytes) -> None:
    with suppress(WireError):
        from_worker().decode(content)


@given(st.data())
def test_a_damaged_picture_is_a_picture_or_a_wire_error(data: st.DataObject) -> None:
    good = bytearray(body(Shown(1, 0.0, frame(0, 1), 0, path([1.0]))))
    for _ in range(data.draw(st.integers(1, 4))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    with suppress(WireError):
        from_worker().decode(bytes(good))


@pytest.mark.parametrize(
    ("dtype", "shape", "content", "complaint"),
    [
        ("<f8", [2**62, 4], b"", "no array"),  # a product that overflows to 0 in 64 bits
        ("<f8", [-1], b"", "shape"),
        ("<f8", [2], b"\0" * 8, "no array"),
        ("<f4", [1], b"\0" * 4, "agreed"),
        ("|O", [1], b"\0" * 8, "agreed"),
        ("<f8", [1, 1, 1, 1, 1], b"\0" * 8, "shape"),
    ],
)
def test_an_array_that_contradicts_itself_is_refused(
    dtype: str, shape: list[int], content: bytes, complaint: str
) -> None:
    plain = msgspec.msgpack.decode(body(Opened("u", "k", "forest", None, None, truth_trees())))
    plain["truth"]["x"] = [dtype, shape, content]
    with pytest.raises(WireError, match=complaint):
        from_worker().decode(msgspec.msgpack.encode(plain))


def test_a_length_beyond_the_limit_is_refused_before_reading() -> None:
    stream = io.BytesIO((LARGEST_MESSAGE + 1).to_bytes(LENGTH_BYTES, "little"))
    with pytest.raises(WireError, match="larger"):
        to_worker().read(stream)


@pytest.mark.parametrize("cut", [1, 3, 5])
def test_a_stream_that_ends_within_a_message_is_an_error(cut: int) -> None:
    packed = to_worker().encode(Seek(1.0))
    with pytest.raises(WireError, match="ends within"):
        to_worker().read(io.BytesIO(packed[:cut]))


def test_arrays_of_other_kinds_are_not_sent() -> None:
    odd = np.array(["a"], dtype=object)
    truth = TruthTrees(x=odd, y=odd, dbh=odd, kind=("tree",))
    with pytest.raises(WireError, match="cannot be sent"):
        from_worker().encode(Opened("u", "k", "forest", None, None, truth))
