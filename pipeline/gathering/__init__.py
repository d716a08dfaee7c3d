"""Gathering: the second level of evidence, what all scans together say of each place."""

from pipeline.gathering.forest import Forest
from pipeline.gathering.gathering import Gathering, GatheringState, no_columns
from pipeline.gathering.packed import PackedMemory
from pipeline.gathering.sight import View, steepest_by_direction

__all__ = [
    "Forest",
    "Gathering",
    "GatheringState",
    "PackedMemory",
    "View",
    "no_columns",
    "steepest_by_direction",
]
