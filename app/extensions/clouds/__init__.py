"""The extension `clouds`: stems, crowns and heights of a whole cloud of a plot, as a terrestrial or mobile
scanner measures it."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from app.extension import Extension, page_folder

if TYPE_CHECKING:
    from fastapi import FastAPI

    from pipeline.io.readers import Format, Source, SourceOptions


def _open_drive(uri: str, path: Path, options: SourceOptions) -> Source:
    """Open a simulated drive through a cloud."""
    from app.extensions.clouds.cloud_drive import open_drive

    return open_drive(uri, path, options)


def _check_drive(uri: str) -> None:
    """Check the options of the address of a drive; UsageError if one is wrong."""
    from app.extensions.clouds.drive_address import parse_drive

    parse_drive(uri)


@cache
def _formats() -> tuple[Format, ...]:
    """Return the simulated drive through a cloud, by its address and for clouds that are opened as runs."""
    from pipeline.io.readers import Format

    return (
        Format(
            "a whole cloud", (), (), _open_drive, scheme="sim:cloud", check=_check_drive, scans_clouds=True
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
