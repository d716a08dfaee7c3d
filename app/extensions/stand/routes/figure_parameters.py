"""Parameters of stand figures in the address of a request."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Query
from pydantic import ValidationError

from app.extensions.stand.parameters import Stand
from app.extensions.stand.volume import LONGEST
from app.web.responses import BadRequestError


def _figure_parameters(
    dbh_min: Annotated[float, Query(ge=0.0, le=1.0)] = 0.07,
    volume: Annotated[str, Query(max_length=LONGEST)] = "",
) -> Stand:
    """Return the parameters of stand figures that a request gives; BadRequestError if the formula is not
    valid.

    Args:
        dbh_min: Minimum diameter [m].
        volume: Volume formula, see `Stand`; empty for none.
    """
    try:
        return Stand(dbh_min=dbh_min, volume=volume.strip())
    except ValidationError as error:
        what = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise BadRequestError(what, remedy='As in "0.00007 * dbh_cm^1.8 * height_m^0.95"') from None


FigureParameters = Annotated[Stand, Depends(_figure_parameters)]
