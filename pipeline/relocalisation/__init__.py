"""Relocalisation: where a constellation of stems stands in a map, without any guess of the pose."""

from pipeline.relocalisation.constellation import Match, Refusal, find_constellation
from pipeline.relocalisation.stems import Stems

__all__ = ["Match", "Refusal", "Stems", "find_constellation"]
