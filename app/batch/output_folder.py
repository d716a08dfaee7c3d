"""Whether a folder may take the files of a run: nobody's run is overwritten by another one unasked."""

from __future__ import annotations

from pathlib import Path

from app.batch.run_folder import read_run_record
from pipeline.errors import StemmapError

_NAMES = (
    "trees.csv",
    "path.csv",
    "trees.geojson",
    "detections.csv",
    "terrain.csv",
    "slices.csv",
    "state.zip",
)
_REMEDY = "Name another folder with --out, or add --force to write over it"


def check_folder(folder: Path, digest: str, *, force: bool) -> bool:
    """Look at the folder before anything is mapped.

    Args:
        folder: For the files of a run.
        digest: Of the run's first source. A run of the same source may be replaced, as when it is mapped
            again with other parameters.
        force: Write over whatever is there.

    Returns:
        Whether a run stands there that will be replaced.

    Raises:
        StemmapError: It holds the run of another source, or files of that name that are no run's.
    """
    if not (folder / "run.json").exists():
        there = [name for name in _NAMES if (folder / name).exists()]
        if there and not force:
            raise StemmapError(
                f"the folder has a file {there[0]} that is not of a run", where=str(folder), remedy=_REMEDY
            )
        return bool(there)
    if force:
        return True
    try:
        source = read_run_record(folder)["source"]
    except StemmapError:
        raise StemmapError(
            "the folder holds a run.json that cannot be read", where=str(folder), remedy=_REMEDY
        ) from None
    if source.get("sha256") != digest:
        raise StemmapError(
            f"the folder holds the map of another source, {source.get('uri')}",
            where=str(folder),
            remedy=_REMEDY,
        )
    return True
