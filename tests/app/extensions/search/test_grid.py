"""Which sets a grid means, and what it refuses."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.extensions.search.grid import GridAxis, combinations, read_axes, spread, words_of
from pipeline.config import assign, preset
from pipeline.errors import ParameterError


@pytest.mark.parametrize(
    ("word", "values"),
    [
        ("clustering.eps = 0.3..0.1/3 ", (0.3, 0.2, 0.1)),
        ("clustering.eps=0.01..1/3log", (0.01, 0.1, 1.0)),
        ("clustering.eps=0.1m,0.2 m", (0.1, 0.2)),
        ("clustering.eps=0.1,0.1..0.2/2,5", (0.1, 0.2, 5.0)),
        ("detection.arc_min=30deg..60deg/4", (30.0, 40.0, 50.0, 60.0)),
        ("slam.noise_distance=0.01m/√m..0.03m/√m/3", (0.01, 0.02, 0.03)),
        ("clustering.min_points=5..7/9", (5, 6, 7)),
        ("clustering.method=dbscan,range_jump", ("dbscan", "range_jump")),
        ("filters.z_min=-2..-1/2", (-2.0, -1.0)),
        ("preset=forest,paper", ("forest", "paper")),
    ],
)
def test_a_word_of_the_command_line(word, values):
    (axis,) = read_axes([word])
    assert axis.values == values
    assert [type(value) for value in axis.values] == [type(value) for value in values]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["clustering.epz=1"], "clustering.epz"),
        (["clustering.eps=9"], "0.01 to 5"),
        (["clustering.eps=nan"], "0.01 to 5"),
        (["clustering.eps="], "0 values"),
        (["clustering.eps=0.1..0.2/1"], "2 to 1,000"),
        (["clustering.eps=0.1..0.2/999999"], "2 to 1,000"),
        (["filters.x_min=-1..1/3log"], "above 0"),
        (["clustering.method=dbscan..range_jump/2"], "not a range"),
        (["preset=wood"], "'wood'"),
        (["clustering.eps=1", "clustering.eps=2"], "twice"),
        (["clustering.eps=0.1..0.2/200", "slam.gate=1..2/200"], "40,000 sets"),
    ],
    ids=str,
)
def test_what_does_not_fit_is_said(words, says):
    with pytest.raises(ParameterError) as refusal:
        read_axes(words)
    assert says in str(refusal.value)


def test_a_file_says_the_same_as_words(tmp_path):
    file = tmp_path / "grid.toml"
    file.write_text(
        'preset = ["forest", "paper"]\n[clustering]\neps = [0.1, 1, "0.2..0.4/3"]\nmethod = "dbscan"\n'
        "[acquisition]\ndeskew = [true, false]\n"
    )
    words = ["preset=forest,paper", "clustering.eps=0.1,1,0.2..0.4/3", "clustering.method=dbscan"]
    assert read_axes([str(file)]) == read_axes([*words, "acquisition.deskew=true,false"])


@pytest.mark.parametrize("text", ["[clustering", "\0", "a = " + "[" * 5000])
def test_a_damaged_file_is_said_in_one_line(tmp_path, text):
    file = tmp_path / "grid.toml"
    file.write_text(text)
    with pytest.raises(ParameterError) as refusal:
        read_axes([str(file)])
    assert "\n" not in str(refusal.value)[:-1]


@given(st.floats(0.01, 5.0), st.floats(0.01, 5.0), st.integers(2, 50), st.booleans())
def test_a_span_has_its_ends_and_even_steps(low, high, count, ratio):
    values = spread(low, high, count, ratio=ratio)
    assert (values[0], values[-1], len(values)) == (low, high, count)
    assert all(min(low, high) * (1 - 1e-12) <= value <= max(low, high) * (1 + 1e-12) for value in values)
    for a, b, c in zip(values, values[1:], values[2:], strict=False):
        if ratio:
            assert b * b == pytest.approx(a * c, rel=1e-9)
        else:
            assert 2.0 * b == pytest.approx(a + c, rel=1e-9)


def test_every_combination_is_there_once_and_reads_as_set_takes_it():
    axes = (
        GridAxis("clustering.eps", (0.1, 0.2)),
        GridAxis("slam.particles", (5, 7, 9)),
        GridAxis("preset", ("forest",)),
    )
    sets = combinations(axes)
    assert len({words_of(changes) for changes in sets}) == len(sets) == 6
    for changes in sets:
        words = [word for word in words_of(changes).split(" ") if not word.startswith("preset=")]
        values = {name: value for name, value in changes.items() if name != "preset"}
        assert preset("forest").replace(values) == assign(preset("forest"), words)
