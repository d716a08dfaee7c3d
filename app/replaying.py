"""The parameters that a recorded live run was mapped with, for the same map again."""

from __future__ import annotations

from pipeline.errors import ParameterError
from pipeline.parameters import Parameters
from pipeline.parameters.model import validated
from pipeline.sources.base import SourceDescription


def recorded_parameters(description: SourceDescription) -> tuple[tuple[int, Parameters], ...]:
    """Each set with the first scan that it is for, in their order; () where nothing was recorded, or what was
    recorded is of another version of stemmap."""
    try:
        return tuple((each.from_scan, validated(each.values)) for each in description.revisions)
    except ParameterError:
        return ()
