"""Gathering: the second level of evidence, what all scans together say of each place."""

from pipeline.classification.column_classifier import Gathering, GatheringState, no_columns
from pipeline.classification.decision_rule import Judged, judged
from pipeline.classification.forest import Forest, ForestOf, package_alone
from pipeline.classification.packed_voxel_map import PackedMemory
from pipeline.classification.ray_statistics import View, depth_image, steepest_by_direction

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
