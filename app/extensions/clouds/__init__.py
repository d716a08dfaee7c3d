"""The extension `clouds`: stems, crowns and heights of a whole cloud of a plot, as a terrestrial or mobile
scanner measures it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from app.extension import Extension, page_folder

if TYPE_CHECKING:
    from fastapi import FastAPI

    from pipeline.io.readers import Format


def _later(module: str, name: str) -> Callable[..., Any]:
    """Return a function that imports a module of this extension and calls its member when it is called."""
    return lambda *given: getattr(import_module(f"{__name__}.{module}"), name)(*given)


@cache
def _formats() -> tuple[Format, ...]:
    """Return the formats of clouds, and the simulated drive through a cloud, by its address and for clouds
    that are opened as runs."""
    from pipeline.io.readers import Format

    ply, las = _later("ply", "open_ply"), _later("las", "open_las")
    return (
        Format("whole cloud .ply", (b"ply\n", b"ply\r"), (".ply",), table=ply, scans="PLY"),
        Format(
            "whole cloud .npy or .npz",
            (b"\x93NUMPY",),
            (".npy", ".npz"),
            table=_later("numpy_file", "open_numpy"),
            scans="NumPy",
        ),
        Format("whole cloud .laz or .las", (b"LASF",), (".las", ".laz"), table=las, scans="LAS"),
        Format(
            "a whole cloud",
            (),
            (),
            _later("cloud_drive", "open_drive"),
            scheme="sim:cloud",
            check=_later("drive_address", "parse_drive"),
            form=_later("cloud_or_scan", "form_of_file"),
        ),
    )


def _add_routes(app: FastAPI) -> None:
    """Add the cloud of the open run to a dashboard."""
    from app.extensions.clouds.routes import router

    app.include_router(router)


EXTENSION = Extension(
    help="whole clouds (.laz, .las, ...): stems, diameters and heights without a drive; clouds of runs",
    takes={
        "map": "app.extensions.clouds.map_command",
        "info": "app.extensions.clouds.info_command",
        "export": "app.extensions.clouds.export_command",
    },
    formats=_formats,
    web=_add_routes,
    sources="app.extensions.clouds.sources",
    page=page_folder("clouds"),
)
