"""Volume formulas against Python's own arithmetic, and texts that are no formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.extensions.stand.volume import LONGEST, FormulaError, VolumeFormula

NUMBERS = st.floats(0.01, 9.0).map(lambda value: f"{value:.3f}")
EXPRESSIONS = st.recursive(
    NUMBERS | st.sampled_from(["dbh_cm", "height_m"]),
    lambda inner: (
        st.tuples(inner, st.sampled_from("+*/^-"), inner).map(lambda p: f"({p[0]} {p[1]} {p[2]})")
        | st.tuples(st.sampled_from(["exp", "log", "sqrt"]), inner).map(lambda p: f"{p[0]}({p[1]})")
        | inner.map(lambda text: f"(-{text})")
    ),
    max_leaves=6,
)


@given(EXPRESSIONS, st.floats(0.05, 1.5), st.floats(2.0, 50.0))
def test_a_formula_has_the_value_of_python_or_none(text, dbh, height):
    names = {"dbh_cm": 100.0 * dbh, "height_m": height, "exp": math.exp, "log": math.log, "sqrt": math.sqrt}
    try:
        wanted = eval(text.replace("^", "**"), {"__builtins__": {}}, names)  # noqa: S307 - the oracle
    except (ValueError, OverflowError, ZeroDivisionError):
        wanted = math.nan
    if isinstance(wanted, complex) or not 0.0 <= wanted < 1e300:
        wanted = math.nan
    (value,) = VolumeFormula.parse(text)(np.array([dbh]), np.array([height]))
    if math.isnan(wanted):
        assert not value < 1e300
    else:
        assert value == pytest.approx(wanted, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        "", "dbh_cm +", "(dbh_cm", "dbh", "__import__('os')", "dbh_cm.real", "dbh_cm[0]", "lambda: 1", "'a'",
        "1 if 1 else 2", "dbh_cm < 3", "exp(1, 2)", "sqrt(*dbh_cm)", "9e999", "1 % 2", "not 1", "1\u00b2",
        "dbh_cm;1", "x" * (LONGEST + 1), "(" * 100 + "1" + ")" * 99, "-" * 40 + "1",
    ],
)  # fmt: skip
def test_other_texts_are_refused_with_a_reason(text):
    with pytest.raises(FormulaError, match="the formula"):
        VolumeFormula.parse(text)


@given(st.text(max_size=60))
def test_any_text_is_a_formula_or_refused(text):
    try:
        formula = VolumeFormula.parse(text)
    except FormulaError:
        return
    assert formula(np.array([0.3]), np.array([20.0])).shape == (1,)


def test_what_is_unknown_or_negative_has_no_volume():
    formula = VolumeFormula.parse("0.001 * (dbh_cm - 10) * height_m")
    volume = formula(np.array([0.2, 0.05, np.nan, 0.2]), np.array([10.0, 10.0, 10.0, np.nan]))
    np.testing.assert_allclose(volume, [0.1, np.nan, np.nan, np.nan])


def test_errors_follow_the_law_of_propagation():
    formula = VolumeFormula.parse("0.0004 * dbh_cm^2 * height_m")
    one = np.ones(1)
    volume, sigma = formula.with_sigma(0.3 * one, 0.002 * one, 20.0 * one, 0.4 * one)
    np.testing.assert_allclose(volume, 0.0004 * 900 * 20)
    np.testing.assert_allclose(sigma, volume * np.hypot(2 * 0.002 / 0.3, 0.4 / 20.0), rtol=1e-3)


def test_the_standard_deviation_comes_from_the_side_with_a_volume():
    """Below 12 cm the formula is negative, so that only the larger diameter has a volume."""
    formula = VolumeFormula.parse("0.01 * (dbh_cm - 12)")
    volume, sigma = formula.with_sigma(*(np.array([value]) for value in (0.13, 0.02, np.nan, np.nan)))
    np.testing.assert_allclose((volume[0], sigma[0]), (0.01, 0.02))
