"""A run that can be continued: `state.zip` in the folder that `stemmap map` wrote."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from app.batch.run_folder import is_of_cloud, read_run_record
from app.batch.run_totals import Tally
from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.errors import StemmapError
from pipeline.io.checkpoints import decode, encode, read_archive, write_archive
from pipeline.io.checkpoints.archive import damaged
from pipeline.io.checkpoints.saved_map import SavedMap

STATE = "state.zip"
FORMAT = 8
LARGEST_FILE = 4 << 30


@dataclass(frozen=True, slots=True)
class RunSource:
    """One source of a map.

    Attributes:
        uri, digest: See SourceDescription.
        from_scan: Number of its first scan in the run.
        start: How its first pose was known: "origin", "resume", "last", "given" or "constellation".
        pose: T_map_start: x, y [m], yaw [rad] of its first pose.
        stems: How many stems agreed with that pose, 0 where it was not found by them.
        stamp_shift_ns: What was added to its times, so that they come after those before.
    """

    uri: str
    digest: str
    from_scan: int
    start: str
    pose: tuple[float, float, float]
    stems: int
    stamp_shift_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class SavedRun:
    """All that a run needs to go on.

    Attributes:
        format: Of the file.
        sources: What was mapped, oldest first.
        preset, parameters: Name, and JSON of all values.
        seed: Of every random number; start_ns: time of the first scan.
        tally: What was counted so far; losses: by reason.
        map: What the mapper knew.
    """

    format: int
    sources: tuple[RunSource, ...]
    preset: str
    parameters: str
    seed: int
    start_ns: int
    tally: Tally
    losses: dict[str, int]
    map: SavedMap

    def chosen_parameters(self) -> Parameters:
        """The parameters of the run's end."""
        return validated(json.loads(self.parameters))

    def as_bytes(self) -> bytes:
        """The file."""
        return write_archive(*encode(self))


def read_saved_run(folder: Path) -> SavedRun:
    """Read the saved state of a run's folder.

    Raises:
        StemmapError: There is none, or it is damaged or of another version.
    """
    file = folder / STATE
    try:
        if file.stat().st_size > LARGEST_FILE:
            raise damaged(str(file), "it is larger than 4 GB")
        data = file.read_bytes()
    except OSError as error:
        if _is_map_of_cloud(folder):
            raise StemmapError(
                "this is the map of a whole cloud, with which no drive goes on",
                where=str(folder),
                remedy="Map a drive by itself and go on with that one, or drive through the cloud with "
                "sim:cloud?file=",
            ) from None
        raise StemmapError(
            f"there is no saved state: {error.strerror}",
            where=str(file),
            remedy="Name a folder that `stemmap map` wrote",
        ) from None
    tree, blob = read_archive(data, str(file))
    if isinstance(tree, dict) and tree.get("format") != FORMAT:
        raise damaged(str(file), f"it has format {tree.get('format')!r} and not {FORMAT}")
    try:
        saved = decode(SavedRun, tree, blob)
        if not saved.sources or not len(saved.map.stamp_ns):
            raise ValueError("there is no scan in it")
        saved.map.state()
        saved.chosen_parameters()
    except (ValueError, RecursionError) as error:
        raise damaged(str(file), str(error)) from None
    except StemmapError as error:
        raise damaged(str(file), error.what) from None
    return saved


def _is_map_of_cloud(folder: Path) -> bool:
    try:
        return is_of_cloud(read_run_record(folder))
    except StemmapError:
        return False
