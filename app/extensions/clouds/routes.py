"""The cloud of the open run as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends
from starlette.responses import Response

from app.dashboard.shown_run import ShownRun
from app.web.routes.access import Dash, OwnerOnly
from app.web.routes.results import exported_file, folder_of_export

router = APIRouter(prefix="/api")


@router.get("/export/laz", dependencies=[OwnerOnly])
async def export_cloud(dashboard: Dash, there: Annotated[Path, Depends(folder_of_export)]) -> Response:
    """Return the cloud of the run as LAZ, see `mapped_cloud.write_cloud`; a child process reads the source
    again, which takes minutes. 409 before the first map; 422 if the source cannot be read."""
    return await exported_file(dashboard, ShownRun.of(dashboard), {"ask": f"{__name__}:cloud"}, there)


def cloud(question: dict[str, Any]) -> dict[str, Any]:
    """Write the cloud of a run to cloud.laz; return {"file": its path}.

    Args:
        question: The key "path" has the folder of the run, and "folder" that of the file.

    Raises:
        StemmapError: See `mapped_cloud.write_cloud`.
    """
    from app.extensions.clouds.mapped_cloud import write_cloud

    file = Path(question["folder"]) / "cloud.laz"
    write_cloud(Path(question["path"]), file)
    return {"file": str(file)}
