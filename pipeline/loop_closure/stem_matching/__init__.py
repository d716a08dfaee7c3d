"""Relocalisation: where a constellation of stems stands in a map, without any guess of the pose."""

from pipeline.loop_closure.stem_matching.constellation import Match, Refusal, find_constellation
from pipeline.loop_closure.stem_matching.stem_constellation import Stems

__all__ = ["Match", "Refusal", "Stems", "find_constellation"]
