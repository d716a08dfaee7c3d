"""Global matching of a constellation of stems with a map, without an initial pose."""

from pipeline.loop_closure.stem_matching.constellation import Match, Refusal, find_constellation
from pipeline.loop_closure.stem_matching.stem_constellation import MapStems

__all__ = ["MapStems", "Match", "Refusal", "find_constellation"]
