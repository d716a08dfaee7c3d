"""Localisation in a stored map: where a robot is in the map of an earlier drive, without an initial pose."""

from app.extensions.maps.localisation.localiser import Localisation, Localiser, State
from app.extensions.maps.localisation.stored_map import StoredMap

__all__ = ["Localisation", "Localiser", "State", "StoredMap"]
