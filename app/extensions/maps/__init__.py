"""The extension `maps`: a run continues the map of an earlier one, is localised in it, or merged with it."""

from __future__ import annotations

from app.extension import Extension

EXTENSION = Extension(
    help="maps of several drives: stemmap map --continue, merge, localise and pack",
    commands={
        "merge": "app.extensions.maps.merge_command",
        "localise": "app.extensions.maps.localise_command",
        "pack": "app.extensions.maps.pack_command",
    },
    takes={"map": "app.extensions.maps.map_command"},
)
