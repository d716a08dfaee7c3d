"""The parameters that a recorded live run was mapped with, for the same map again."""

from __future__ import annotations

from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.errors import ParameterError
from pipeline.io.readers.base import SourceDescription


def recorded_parameters(description: SourceDescription) -> tuple[tuple[int, Parameters], ...]:
    """Each set with the first scan that it is for, in their order; () where nothing was recorded, or what was
    recorded is of another version of stemmap.

    A set that acted on the whole run, which was mapped again with it, takes the place of those before it.
    """
    sets: list[tuple[int, Parameters]] = []
    try:
        for each in description.revisions:
            values = validated(each.values)
            sets = [known for known in sets if known[0] < each.from_scan]
            sets.append((each.from_scan, values))
    except ParameterError:
        return ()
    return tuple(sets)
