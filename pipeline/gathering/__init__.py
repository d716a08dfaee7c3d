"""Gathering: the second level of evidence, what all scans together say of each place."""

from pipeline.gathering.forest import Forest
from pipeline.gathering.gathering import Gathering, GatheringState
from pipeline.gathering.sight import View, steepest_by_direction

__all__ = ["Forest", "Gathering", "GatheringState", "View", "steepest_by_direction"]
