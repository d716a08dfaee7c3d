"""Rerun: the whole run again after a change, from what its scans showed and what was made of them."""

from pipeline.remapping.cache_key import look_key
from pipeline.remapping.journal import Journal
from pipeline.remapping.named_cache import Name, name_of
from pipeline.remapping.preview import rough_trees
from pipeline.remapping.rerun import Reread, Rerun
from pipeline.remapping.resume_point import Basis
from pipeline.remapping.retracking import Recalled
from pipeline.remapping.sample import Sample
from pipeline.remapping.scan_cache import DamagedError, KeptScans

__all__ = [
    "Basis",
    "DamagedError",
    "Journal",
    "KeptScans",
    "Name",
    "Recalled",
    "Reread",
    "Rerun",
    "Sample",
    "look_key",
    "name_of",
    "rough_trees",
]
