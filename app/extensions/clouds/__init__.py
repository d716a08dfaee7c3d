"""The extension `clouds`: stems, crowns and heights of a whole cloud of a plot, as a terrestrial or mobile
scanner measures it."""

from __future__ import annotations

from app.extension import Extension, page_folder

EXTENSION = Extension(
    help="whole clouds (.laz, .las, .e57, ...): their stems, diameters and heights, mapped without a drive",
    takes={
        "map": "app.extensions.clouds.map_command",
        "info": "app.extensions.clouds.info_command",
    },
    sources="app.extensions.clouds.sources",
    page=page_folder("clouds"),
)
