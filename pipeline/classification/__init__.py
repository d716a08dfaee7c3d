"""Classification of voxel columns: the returns of all scans accumulated by position in the map."""

from pipeline.classification.column_classifier import (
    ColumnClassifier,
    ColumnClassifierState,
    ColumnVotes,
    column_votes,
    no_columns,
)
from pipeline.classification.forest import Forest, ForestOf, package_alone
from pipeline.classification.ray_statistics import ScanView, view_by_direction
from pipeline.classification.voxel_map import PackedVoxelMap

__all__ = [
    "ColumnClassifier",
    "ColumnClassifierState",
    "ColumnVotes",
    "Forest",
    "ForestOf",
    "PackedVoxelMap",
    "ScanView",
    "column_votes",
    "no_columns",
    "package_alone",
    "view_by_direction",
]
