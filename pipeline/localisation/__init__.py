"""Localisation in a stored map: where a robot is in the map of an earlier drive, without an initial pose."""

from pipeline.localisation.localiser import Localisation, Localiser, State
from pipeline.localisation.stored_map import StoredMap

__all__ = ["Localisation", "Localiser", "State", "StoredMap"]
