"""Stem volume by a formula of the user, such as "0.00007 * dbh_cm^1.8 * height_m^0.95"."""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.geometry.poses import Float

LONGEST = 300  # characters
DEEPEST = 30  # nested operations
VARIABLES = ("dbh_cm", "height_m")
_FUNCTIONS: dict[str, Callable[[Any], Any]] = {"exp": np.exp, "log": np.log, "sqrt": np.sqrt}
_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.UAdd: np.positive,
    ast.USub: np.negative,
}


class FormulaError(ValueError):
    """A text that is not a volume formula; the message states the reason."""


@dataclass(frozen=True, slots=True)
class VolumeFormula:
    """A checked formula of the volume of a stem [m^3].

    Its grammar: numbers, `dbh_cm` and `height_m`, + - * / ^ and parentheses, and exp, log (natural) and sqrt.

    Attributes:
        text: The formula as it was written.
        expression: Syntax tree of the formula, which has only elements of the grammar.
    """

    text: str
    expression: ast.expr

    @classmethod
    def parse(cls, text: str) -> VolumeFormula:
        """Return the formula of a text.

        Raises:
            FormulaError: The text is longer than LONGEST, nested deeper than DEEPEST, or not of the grammar.
        """
        if len(text) > LONGEST:
            raise FormulaError(f"the formula has more than {LONGEST} characters")
        if not text.isascii() or "#" in text:
            raise FormulaError("the formula has characters that it may not have")
        try:
            tree = ast.parse(text.strip().replace("^", "**"), mode="eval").body
        except (SyntaxError, ValueError, MemoryError, RecursionError):
            raise FormulaError("the formula cannot be read: an operand or a parenthesis is missing") from None
        _check(tree, DEEPEST)
        return cls(text, tree)

    def __call__(self, dbh: Float, height: Float) -> Float:
        """Return volumes, shape (T,) [m^3]; NaN where the formula has no finite value of at least 0, where
        the diameter is unknown, and where it contains a height that is unknown.

        Args:
            dbh, height: Diameters at breast height and heights, shape (T,) [m]; NaN where unknown.
        """
        values = {"dbh_cm": 100.0 * dbh, "height_m": height}
        with np.errstate(all="ignore"):
            volume = np.broadcast_to(np.asarray(_value(self.expression, values), np.float64), dbh.shape)
            return np.where(np.isfinite(volume) & (volume >= 0.0) & np.isfinite(dbh), volume, np.nan)

    def with_sigma(
        self, dbh: Float, dbh_sigma: Float, height: Float, height_sigma: Float
    ) -> tuple[Float, Float]:
        """Return volumes and their standard deviations by those of diameter and height, shape (T,) [m^3].
        Unknown standard deviations count as 0; where the volume is NaN, its standard deviation is 0.

        Args:
            dbh, dbh_sigma, height, height_sigma: Diameters, heights and their standard deviations, shape (T,)
                [m]; NaN where unknown.
        """
        d, h = np.nan_to_num(dbh_sigma), np.nan_to_num(height_sigma)
        volume = self(dbh, height)
        by_dbh = _half_range(volume, self(dbh + d, height), self(np.where(d < dbh, dbh - d, np.nan), height))
        lower = np.where(h < height, height - h, np.nan)
        by_height = _half_range(volume, self(dbh, height + h), self(dbh, lower))
        return volume, np.hypot(by_dbh, by_height)


def _half_range(volume: Float, above: Float, below: Float) -> Float:
    """Return the change of a volume within one standard deviation of a measurement, shape (T,) [m^3]: the
    mean of both sides, or that of the side with a volume; 0 if there is none.

    Args:
        volume: The volume; NaN where it is unknown.
        above, below: The volume with the measurement increased and decreased by its standard deviation.
    """
    sides = np.stack([above - volume, volume - below])
    known = np.isfinite(sides)
    change: Float = np.abs(np.where(known, sides, 0.0).sum(axis=0)) / np.maximum(known.sum(axis=0), 1)
    return change


def _check(node: ast.AST, levels: int) -> None:
    """Check that an expression has only what the grammar allows.

    Args:
        node: The expression.
        levels: Number of nested operations that it may have.

    Raises:
        FormulaError: The expression has more levels, or an element that is not of the grammar.
    """
    if levels < 0:
        raise FormulaError(f"the formula is nested deeper than {DEEPEST} operations")
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            if not abs(value) < 1e300:
                raise FormulaError("the formula has a number that is too large")
        case ast.Name(id=name):
            if name not in VARIABLES:
                raise FormulaError(f"the formula has {name!r}; its variables are {' and '.join(VARIABLES)}")
        case ast.UnaryOp(op=operator, operand=operand) if type(operator) in _OPERATORS:
            _check(operand, levels - 1)
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
            _check(left, levels - 1)
            _check(right, levels - 1)
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
            _check(argument, levels - 1)
        case _:
            raise FormulaError(
                "the formula has more than numbers, dbh_cm, height_m, + - * / ^ ( ), exp, log and sqrt"
            )


def _value(node: ast.AST, values: dict[str, Float]) -> Any:  # noqa: ANN401 - an array or a number
    """Return the value of an expression that `_check` accepted for arrays of the variables by name: an array
    of their shape, or a number if it has no variable."""
    match node:
        case ast.Constant(value=value):
            return np.float64(value)  # type: ignore[arg-type]
        case ast.Name(id=name):
            return values[name]
        case ast.UnaryOp(op=operator, operand=operand):
            return _OPERATORS[type(operator)](_value(operand, values))
        case ast.BinOp(left=left, op=operator, right=right):
            return _OPERATORS[type(operator)](_value(left, values), _value(right, values))
        case ast.Call(func=ast.Name(id=name), args=[argument]):
            return _FUNCTIONS[name](_value(argument, values))
    raise AssertionError("the expression was checked")
