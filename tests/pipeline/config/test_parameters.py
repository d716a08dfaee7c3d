"""Parameters: one declaration each, validation, presets, and conversion to text and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.config import (
    PRESETS,
    Parameters,
    assign,
    field_specs,
    from_toml,
    markdown_table,
    preset,
    to_toml,
)
from pipeline.config.model import toml_table, value_text
from pipeline.errors import ParameterError

SPECS = field_specs()
NUMBERS: list[Any] = [spec for spec in SPECS if spec.kind in ("float", "int")]
UNITS = {"", "m", "s", "m/m", "m/s", "m/s²", "m/√m", "deg", "deg/√m", "deg/√rad", "sigma", "m²"}


def replaced(name: str, value: object) -> Parameters | str:
    """The preset forest with one value changed, or why that cannot be."""
    try:
        return preset("forest").replace({name: value})
    except ParameterError as error:
        return str(error)


def test_the_preset_paper_is_table_1():
    values = preset("paper").flat()
    table_1 = {
        "slam.particles": 100,
        "detection.e_max": 20.0,
        "filters.voxel_size": 0.01,
        "clustering.eps": 0.25,
        "clustering.min_points": 20,
        "clustering.method": "dbscan",
        "tracking.proximity_radius": 1.0,
        "detection.cylindrical_stddev_thresh": 0.1,
        "filters.x_min": 0.0,
        "filters.x_max": 10.0,
        "filters.y_min": -10.0,
        "filters.y_max": 10.0,
        "filters.z_min": -0.5,
        "filters.z_max": 0.0,
    }
    assert {name: values[name] for name in table_1} == table_1


def test_the_preset_paper_switches_off_what_the_paper_does_not_have():
    p = preset("paper")
    assert p.ground.method == "none"
    assert p.acquisition.level == "none"
    assert not p.acquisition.deskew
    assert p.shape.centre == "centroid"
    assert p.detection.e_min == 1.0


def test_the_text_of_the_paper_differs_from_its_table_by_one_bound():
    assert preset("paper-text").changes_from(preset("paper")) == {"detection.e_min": 10.0}


def test_forest_is_the_default():
    assert preset("forest") == Parameters()
    assert next(iter(PRESETS)) == "forest"


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_within_the_bounds_and_has_a_source(name):
    values: dict[str, Any] = dict(preset(name).flat())
    for spec in NUMBERS:
        assert spec.minimum is not None
        assert spec.maximum is not None
        assert spec.minimum <= values[spec.name] <= spec.maximum
    assert PRESETS[name][0]
    assert "  " not in PRESETS[name][0]


def test_every_parameter_has_title_unit_and_explanation():
    for spec in SPECS:
        assert spec.title[0].isupper() or spec.title[0] in "xyz", spec.name
        assert spec.doc.endswith("."), spec.name
        assert len(spec.doc) > 20, spec.name
        assert "|" not in spec.doc + spec.title, f"{spec.name}: it would break the table in README"
        assert spec.unit in UNITS, spec.name
        assert spec.stage, spec.name


def test_every_number_has_bounds_a_step_and_a_default_between():
    for spec in NUMBERS:
        assert 0 < spec.step <= spec.maximum - spec.minimum, spec.name
        assert spec.minimum <= spec.default <= spec.maximum, spec.name
        assert spec.kind == "float" or spec.step == 1, spec.name


def test_bounds_are_inclusive():
    for spec in NUMBERS:
        number = int if spec.kind == "int" else float
        beyond = 1 if spec.kind == "int" else 1e-6
        for value in (number(spec.minimum - beyond), number(spec.maximum + beyond)):
            with pytest.raises(ParameterError, match=spec.name.replace(".", r"\.")):
                preset("forest").replace({spec.name: value})
        for bound in (spec.minimum, spec.maximum):
            told = replaced(spec.name, number(bound))
            if isinstance(told, str):  # the other end of a pair stands in its way, and is named
                assert "must be less than" in told, spec.name
            else:
                assert told.flat()[spec.name] == bound


@pytest.mark.parametrize("value", [float("nan"), float("inf"), True, "0.3"])
def test_an_invalid_number_is_rejected(value):
    with pytest.raises(ParameterError, match=r"clustering\.eps"):
        preset("forest").replace({"clustering.eps": value})


@pytest.mark.parametrize("value", [True, 3.5])
def test_an_invalid_integer_is_rejected(value):
    with pytest.raises(ParameterError, match=r"clustering\.min_points"):
        preset("forest").replace({"clustering.min_points": value})


@pytest.mark.parametrize(
    ("name", "value"), [("acquisition.deskew", 1), ("acquisition.level", "imuu"), ("clustering.engine", 0)]
)
def test_an_invalid_choice_is_rejected(name, value):
    with pytest.raises(ParameterError, match=name.replace(".", r"\.")):
        preset("forest").replace({name: value})


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ("filters.x_min", "filters.x_max"),
        ("filters.y_min", "filters.y_max"),
        ("filters.z_min", "filters.z_max"),
        ("ground.height_min", "ground.height_max"),
        ("acquisition.range_min", "acquisition.range_max"),
        ("detection.e_min", "detection.e_max"),
        ("detection.radius_min", "detection.radius_max"),
    ],
)
@pytest.mark.parametrize("apart", [0.0, 0.5])
def test_the_message_names_both_crossing_limits(low, high, apart):
    with pytest.raises(ParameterError) as caught:
        preset("forest").replace({low: 1.5 + apart, high: 1.5})
    assert low in str(caught.value)
    assert high in str(caught.value)


def test_both_limits_may_change_in_one_call():
    moved = preset("forest").replace({"filters.z_min": 30.0, "filters.z_max": 40.0})
    assert (moved.filters.z_min, moved.filters.z_max) == (30.0, 40.0)


def test_replace_does_not_modify_the_original():
    before = preset("forest")
    after = before.replace({"clustering.eps": 0.3})
    assert after.changes_from(before) == {"clustering.eps": 0.3}
    assert before == Parameters()
    with pytest.raises(ValueError, match="frozen"):
        before.clustering.eps = 0.3


@pytest.mark.parametrize("name", ["clustering.epz", "", "clusterin.eps"])
def test_an_unknown_name_is_rejected_with_the_nearest_name(name):
    with pytest.raises(ParameterError) as caught:
        preset("forest").replace({name: 1.0})
    assert "\n" not in str(caught.value)
    if name == "clustering.epz":
        assert "clustering.eps" in str(caught.value)


def test_an_unknown_preset_names_the_known_ones():
    with pytest.raises(ParameterError) as caught:
        preset("wood")
    assert all(name in str(caught.value) for name in PRESETS)


# --- text -----------------------------------------------------------------------------------------


@given(st.data())
def test_values_round_trip_through_toml(data):
    spec = data.draw(st.sampled_from(NUMBERS))
    lowest, highest = spec.minimum, spec.maximum
    value = (
        data.draw(st.integers(int(lowest), int(highest)))
        if spec.kind == "int"
        else data.draw(st.floats(lowest, highest))
    )
    chosen = replaced(spec.name, value)
    if isinstance(chosen, str):
        assert "must be less than" in chosen
        return
    assert from_toml(to_toml(chosen), preset("paper"), "x.toml") == chosen
    assert assign(preset("forest"), [f"{spec.name}={value!r}"]) == chosen


def test_toml_may_omit_values_and_write_lengths_as_integers():
    chosen = from_toml("[clustering]\neps = 1\n", preset("paper"), "x.toml")
    assert chosen.changes_from(preset("paper")) == {"clustering.eps": 1.0}
    assert from_toml("", preset("paper"), "x.toml") == preset("paper")


@pytest.mark.parametrize(
    "text",
    [
        "[clustering",
        "[clustering]\neps = nan",
        "[clustering]\nmin_points = 3.0",
        "[nothing]\neps = 0.3",
        "[clustering.eps]\na = 1",
        "clustering = 3",
        "[filters]\nx_min = 5.0\nx_max = 5.0",
        "[clustering]\neps = 1" + 5000 * "0",
        "[clustering]\neps = " + 3000 * "[" + 3000 * "]",
        "a" + 25_000 * ".a" + " = 1",
        "[" + "a." * 25_000 + "a]",
        "[[clustering]]\neps = 0.3",
        "# " + 1_000_000 * "x",
    ],
    ids=lambda text: repr(text[:28]),
)
def test_an_invalid_toml_gives_one_line_with_the_file_name(text):
    with pytest.raises(ParameterError) as caught:
        from_toml(text, preset("forest"), "mine.toml")
    message = str(caught.value)
    assert "mine.toml" in message
    assert "\n" not in message
    assert len(message) < 500


def test_long_lists_and_paths_are_not_names_of_many_parts():
    numbers = ", ".join(f"{k}.5" for k in range(500))
    text = f"[clustering]\neps = [{numbers}]\npath = '{'/a.b' * 15}'\n"
    assert len(toml_table(text, "grid.toml")["clustering"]["eps"]) == 500


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("clustering.eps", "stage.name=value"),
        ("=1", "no parameter"),
        ("clustering.eps=abc", "should be a number"),
        ("clustering.eps=99", "less than or equal to 5"),
        ("clustering.min_points=8.0", "whole number"),
        ("acquisition.deskew=yes", "boolean"),
        ("acquisition.level=IMU", "'none' or 'imu'"),
    ],
)
def test_an_invalid_assignment_gives_the_reason(text, says):
    with pytest.raises(ParameterError) as caught:
        assign(preset("forest"), [text])
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_later_assignments_override_earlier_ones():
    chosen = assign(
        preset("forest"),
        ["clustering.eps=0.3", " clustering.eps = 0.4 ", "acquisition.deskew=false", "slam.particles=7"],
    )
    assert chosen.clustering.eps == 0.4
    assert chosen.acquisition.deskew is False
    assert chosen.slam.particles == 7


def test_the_table_has_a_row_per_parameter_and_a_column_per_preset():
    table = markdown_table({name: preset(name) for name in PRESETS}).splitlines()
    assert len(table) == 2 + len(SPECS)
    assert len({line.count("|") for line in table}) == 1
    for spec, line in zip(SPECS, table[2:], strict=True):
        assert line.startswith(f"| `{spec.name}` |")
        for name in PRESETS:
            value = preset(name).flat()[spec.name]
            assert f"| {value_text(value)} |" in line


def test_values_are_plain_python_numbers():
    for value in preset("forest").replace({"clustering.eps": np.float64(0.3)}).flat().values():
        assert type(value) in (int, float, bool, str)
