"""Gathering: the second level of evidence, what all scans together say of each place."""

from pipeline.gathering.forest import Forest, ForestOf, package_alone
from pipeline.gathering.gathering import Gathering, GatheringState, no_columns
from pipeline.gathering.judged import Judged, judged
from pipeline.gathering.packed import PackedMemory
from pipeline.gathering.sight import View, depth_image, steepest_by_direction

__all__ = [
    "Forest",
    "ForestOf",
    "Gathering",
    "GatheringState",
    "Judged",
    "PackedMemory",
    "View",
    "depth_image",
    "judged",
    "no_columns",
    "package_alone",
    "steepest_by_direction",
]
