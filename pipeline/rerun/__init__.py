"""Rerun: the whole run again after a change, from what its scans showed and what was made of them."""

from pipeline.rerun.basis import Basis
from pipeline.rerun.journal import Journal
from pipeline.rerun.kept import DamagedError, KeptScans
from pipeline.rerun.key import look_key
from pipeline.rerun.named import Name, name_of
from pipeline.rerun.rerun import Reread, Rerun
from pipeline.rerun.rough import rough_trees
from pipeline.rerun.sample import Sample
from pipeline.rerun.tail import Recalled

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
