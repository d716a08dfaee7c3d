"""Locations of the static files: source checkout, installed package, and plotly."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from pipeline.errors import StemmapError


@cache
def page_folder() -> Path:
    """Return the folder of index.html: `app/static` of an installed package, or `static/` of a checkout.

    Raises:
        StemmapError: Neither folder exists.
    """
    package = Path(str(files("app")))
    for folder in (package / "static", package.parent / "static"):
        if (folder / "index.html").is_file():
            return folder
    raise StemmapError("the page is missing", where=str(package / "static"), remedy="Install stemmap again")


@cache
def plotly_script() -> Path:
    """Return the path of plotly.min.js without importing plotly, which is slow.

    Raises:
        StemmapError: plotly is not installed.
    """
    spec = find_spec("plotly")
    for folder in spec.submodule_search_locations or () if spec else ():
        script = Path(folder) / "package_data" / "plotly.min.js"
        if script.is_file():
            return script
    raise StemmapError("plotly is not installed", remedy="Install stemmap again")
