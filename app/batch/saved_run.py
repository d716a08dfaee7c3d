"""The saved state of a run (`state.zip`), and how a run begins."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from app.batch.run_folder import is_of_drive, read_run_record
from app.batch.summary import RunTotals
from pipeline.config import Parameters
from pipeline.config.model import validated
from pipeline.errors import StemmapError
from pipeline.io.checkpoints import decode, encode, read_archive, write_archive
from pipeline.io.checkpoints.codec import damaged
from pipeline.io.checkpoints.saved_map import SavedMap
from pipeline.io.readers.base import Source
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import OdometryChoice, steps
from pipeline.types.records import Step, Truth

STATE = "state.zip"
FORMAT = 10
LARGEST_FILE = 4 << 30


@dataclass(frozen=True, slots=True)
class RunSource:
    """One source of a map.

    Attributes:
        uri, digest: See SourceDescription.
        from_scan: Number of its first scan in the run.
        start: How its first pose was found: "origin", "resume", "last", "given" or "constellation".
        pose: T_map_start: x, y [m], yaw [rad] of its first pose.
        stems: Number of stems that agreed with that pose; 0 where it was not found by stems.
        stamp_shift_ns: Offset that was added to its times, so that they follow the earlier sources [ns].
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
    """The state of a run after its last scan, from which an extension can go on.

    Attributes:
        format: Version of the file.
        sources: The mapped sources, oldest first.
        preset, parameters: Name of the preset, and JSON of all parameters.
        seed: Random seed.
        start_ns: Time of the first scan [ns].
        tally: Counts so far.
        losses: Dict from reasons to numbers of messages that were left out.
        map: State of the mapper.
    """

    format: int
    sources: tuple[RunSource, ...]
    preset: str
    parameters: str
    seed: int
    start_ns: int
    tally: RunTotals
    losses: dict[str, int]
    map: SavedMap

    def chosen_parameters(self) -> Parameters:
        """Return the parameters at the end of the run; raises ParameterError if they are invalid, and
        ValueError if they are not JSON."""
        return validated(json.loads(self.parameters))

    def as_bytes(self) -> bytes:
        """Return the bytes of the file state.zip."""
        return write_archive(*encode(self))


def read_saved_run(folder: Path) -> SavedRun:
    """Read the saved state in the folder of a run.

    Raises:
        StemmapError: There is none, it is larger than 4 GB, damaged or has another version, or the map is
            not that of a drive.
    """
    file = folder / STATE
    try:
        if file.stat().st_size > LARGEST_FILE:
            raise damaged(str(file), "it is larger than 4 GB")
        data = file.read_bytes()
    except OSError as error:
        if _is_without_drive(folder):
            raise StemmapError(
                "this is no map of a drive and cannot be continued",
                where=str(folder),
                remedy="Map a drive and continue that map",
            ) from None
        raise StemmapError(
            f"there is no saved state: {error.strerror}",
            where=str(file),
            remedy="Name a folder that `stemmap map` wrote",
        ) from None
    tree, blob = read_archive(data, str(file))
    if isinstance(tree, dict) and tree.get("format") != FORMAT:
        raise StemmapError(
            f"its state has format {tree.get('format')!r}, and this version reads {FORMAT}",
            where=str(file),
            remedy="Map the recording again with this version",
        )
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


def _is_without_drive(folder: Path) -> bool:
    """Return whether a folder has a map, and it is no map of a drive."""
    try:
        return not is_of_drive(read_run_record(folder))
    except StemmapError:
        return False


@dataclass(slots=True, eq=False)
class RunStart:
    """How a run begins: as the first of a map, or after earlier runs.

    Attributes:
        tally, losses: Counts of the earlier runs.
        scans: Number of scans of the earlier runs.
        sources: All sources, the present one last.
        start_ns: Time of the first scan of all; None before it.
        after_ns: Scans up to this time (included) are in the map already [ns]; None for none.
        stamp_shift_ns: Offset that is added to the times of this source [ns].
        truth: Ground truth in the frame of the map, where the source's own truth is in another frame.
    """

    tally: RunTotals
    scans: int = 0
    sources: tuple[RunSource, ...] = ()
    start_ns: int | None = None
    after_ns: int | None = None
    stamp_shift_ns: int = 0
    losses: Counter[str] = field(default_factory=Counter)
    truth: Truth | None = None

    def steps(self, source: Source, odometry: OdometryChoice, left_out: Counter[str]) -> Iterator[Step]:
        """Yield the steps that are not in the map yet, with indices and times that continue those of the map.
        Scans up to `after_ns` are skipped and not counted.

        Args:
            source: Source of the run.
            odometry: Choice of the odometry.
            left_out: Counter from reasons to numbers of records that the synchroniser leaves out; increased
                in place.

        Raises:
            SourceError: The source cannot be read.
        """
        index = self.scans
        for step in steps(source.records(), odometry=odometry, losses=left_out):
            stamp = step.scan.stamp_ns + self.stamp_shift_ns
            if self.after_ns is not None and stamp <= self.after_ns:
                continue
            yield replace(step, index=index, scan=replace(step.scan, stamp_ns=stamp))
            index += 1


def at_origin(source: Source, warnings: list[str]) -> RunStart:
    """Return the start of the first run of a map, whose first pose is the origin.

    Args:
        source: Source of the run.
        warnings: Messages for the user, the first warnings of the run.
    """
    known = source.description
    first = RunSource(known.uri, known.digest, 0, "origin", (0.0, 0.0, 0.0), 0, 0)
    return RunStart(RunTotals(Counter(warnings)), sources=(first,))


class EarlierRun(Protocol):
    """A run whose map another run goes on with."""

    @property
    def folder(self) -> Path:
        """Folder of its files."""

    @property
    def saved(self) -> SavedRun:
        """Its state."""

    def begin(
        self, source: Source, mapper: Mapper, odometry: OdometryChoice, seed: int, warnings: list[str]
    ) -> RunStart:
        """Load the map into a mapper before its first scan, and return how the run begins in it.

        Args:
            source: Source of the new run.
            mapper: The mapper.
            odometry: Choice of the odometry.
            seed: Random seed.
            warnings: Messages for the user that are added to the totals.

        Raises:
            StemmapError: The start in the map was not found, or the source cannot be read.
        """
