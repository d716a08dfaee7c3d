"""The extension `maps`: a run continues the map of an earlier one, and two maps are merged."""

from __future__ import annotations

from app.extension import Extension

EXTENSION = Extension(
    help="maps of several drives: stemmap map --continue, and stemmap merge",
    commands={"merge": "app.extensions.maps.merge_command"},
    takes={"map": "app.extensions.maps.map_command"},
)
