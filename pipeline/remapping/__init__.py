"""Remapping: a run mapped again with other parameters, and the preview of its result."""

from pipeline.remapping.preview import ClusterTable, KnownMap, needs_sample, preview_trees, sample_scans
from pipeline.remapping.rerun import Reread, Rerun, ScanCache, ScanCaches, segmentation_key

__all__ = [
    "ClusterTable",
    "KnownMap",
    "Reread",
    "Rerun",
    "ScanCache",
    "ScanCaches",
    "needs_sample",
    "preview_trees",
    "sample_scans",
    "segmentation_key",
]
