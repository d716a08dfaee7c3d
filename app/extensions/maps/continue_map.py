"""Continuing a map: where another run starts in the map of a saved run."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from app.batch.saved_run import RunSource, RunStart, SavedRun
from app.sources.opening import open_source
from app.store.forests import mapper_of
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2
from pipeline.io.readers import SourceOptions
from pipeline.io.readers.base import Source
from pipeline.loop_closure.stem_matching import MapStems, Match, find_constellation
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import OdometryChoice, steps
from pipeline.types.records import Truth

Start = Literal["auto", "resume", "last"] | Pose2
GIVEN_SIGMA = (0.3, 0.3, np.radians(5.0))  # m, m, rad; accuracy of a pose that a user gives
PAUSE_NS = 1_000_000_000  # between two runs whose times overlap
FIRST_TRY, NEXT_TRY = 10, 1.3  # first attempt after so many scans, then after 1.3 times as many
HYPOTHESES = 1_000_000
KNOWN_ALREADY = "this recording is already part of the map; its errors count twice"


@dataclass(frozen=True, slots=True, eq=False)
class ContinuedMap:
    """A saved run that is continued (an `EarlierRun`), and where the robot starts in its map."""

    folder: Path
    saved: SavedRun
    start: Start

    def begin(
        self, source: Source, mapper: Mapper, odometry: OdometryChoice, seed: int, warnings: list[str]
    ) -> RunStart:
        """Load the map and return how the run begins, see `continue_map`."""
        return continue_map(self, source, mapper, odometry, seed, warnings)


def continue_map(
    continued: ContinuedMap,
    source: Source,
    mapper: Mapper,
    odometry: OdometryChoice,
    seed: int,
    warnings: list[str],
) -> RunStart:
    """Load the saved map into a new mapper, and return how the run begins in it. With another start than
    "resume", times of the new run are shifted to follow those of the saved one.

    Args:
        continued: The saved run, and where the robot starts; the totals of the saved run are continued in
            place.
        source: Source of the new run.
        mapper: A mapper before its first scan; it receives the map, with "resume" also the state of its
            odometry, and, unless the start is "resume" or "last", the pose of the start.
        odometry: Choice of the odometry.
        seed: Random seed.
        warnings: Messages for the user that are added to the totals, except with "resume".

    Raises:
        StemmapError: The start had to be found by the stems and was not, or the source cannot be read.
    """
    saved, start = continued.saved, continued.start
    path = saved.map.stamp_ns
    begin = RunStart(
        saved.tally, len(path), saved.sources, saved.start_ns, int(path[-1]), losses=Counter(saved.losses)
    )
    if start == "resume":
        mapper.load(saved.map.state(), path, saved.map.sigma_xy, saved.map.motion)
        return _resumed(begin, source)
    found: Match | None = None
    pose = start if isinstance(start, Pose2) else None
    covariance = np.diag(np.square(GIVEN_SIGMA))
    if start == "auto":
        found = localise(
            source, mapper.parameters, MapStems.of_trees(saved.map.trees(mapper.parameters)), odometry, seed
        )
        pose, covariance = found.pose, found.covariance
    mapper.load(replace(saved.map.state(), odometry=None), path, saved.map.sigma_xy, saved.map.motion)
    if pose is None:
        end = mapper.path
        pose = Pose2(float(end.x[-1]), float(end.y[-1]), float(end.yaw[-1]))
    else:
        mapper.place(len(path), pose, covariance)
    return _in_another_run(begin, source, start, pose, found, warnings)


def _resumed(begin: RunStart, source: Source) -> RunStart:
    """Modify and return `begin` for a run that continues the same drive: the time offset is that of the last
    source. If the source has the digest of the last source, the losses are cleared, since they are counted
    again; otherwise it is appended to the sources."""
    known, last = source.description, begin.sources[-1]
    begin.stamp_shift_ns = last.stamp_shift_ns
    if known.digest == last.digest:
        begin.losses.clear()  # they are counted again, because the source is read from its start
        return begin
    part = RunSource(known.uri, known.digest, begin.scans, "resume", last.pose, 0, last.stamp_shift_ns)
    begin.sources += (part,)
    return begin


def _in_another_run(
    begin: RunStart, source: Source, start: Start, pose: Pose2, found: Match | None, warnings: list[str]
) -> RunStart:  # fmt: skip
    """Modify and return `begin` for another drive. The source is appended to the sources. If its first scan
    is not later than the map, its times are shifted so that this scan follows the map by PAUSE_NS. The truth
    is that of the first source, see `_truth_of`. If the source is part of the map already, a warning is
    added. Raises SourceError if the source cannot be read.

    Args:
        begin: The start so far.
        source: Source of the new run.
        start: Where the user starts it.
        pose: Pose of its first scan in the map.
        found: The match by stems; None if there is none.
        warnings: Messages for the user that are added to the totals.
    """
    known, after_ns = source.description, begin.after_ns or 0
    first_ns = next((s.scan.stamp_ns for s in steps(source.records(), odometry="static")), 0)
    begin.stamp_shift_ns = max(after_ns + PAUSE_NS - first_ns, 0) if first_ns <= after_ns else 0
    how = "given" if isinstance(start, Pose2) else "last" if start == "last" else "constellation"
    part = RunSource(
        known.uri, known.digest, begin.scans, how, (pose.x, pose.y, pose.yaw),
        0 if found is None else len(found.local), begin.stamp_shift_ns,
    )  # fmt: skip
    if known.digest in (part.digest for part in begin.sources):
        begin.tally.warned[f"{KNOWN_ALREADY} ({known.uri})"] += 1
    begin.truth = _truth_of(begin.sources[0].uri)
    begin.sources += (part,)
    begin.tally.warned.update(warnings)
    return begin


def localise(
    source: Source, parameters: Parameters, reference: MapStems, odometry: OdometryChoice, seed: int
) -> Match:
    """Return the match of the first scans of a source with a map; its pose is that of the first scan and
    never None. The scans are mapped separately; the match is tried after 10 scans, then whenever their number
    has grown by 30 %, and after the last.

    Args:
        source: The source.
        parameters: Parameters of the mapper.
        reference: Stems of the map.
        odometry: Choice of the odometry.
        seed: Random seed.

    Raises:
        StemmapError: No match was found up to the last scan (the message has the last reason), or the source
            cannot be read.
    """
    mapper = mapper_of(source.description, parameters, seed)
    due, match = float(FIRST_TRY), None
    coming = steps(source.records(), odometry=odometry)
    step = next(coming, None)
    while step is not None:
        frame, following = mapper.process(step), next(coming, None)
        if step.index + 1 >= due or following is None:
            due = NEXT_TRY * (step.index + 1)
            stems = MapStems.of_trees(frame.trees)
            match = find_constellation(stems, reference, parameters.relocalisation, hypotheses=HYPOTHESES)
            if match.pose is not None:
                return match
        step = following
    raise StemmapError(
        f"the robot was not found in the saved map: {match.reason if match else 'the source has no scan'}",
        where=source.description.uri,
        remedy="Continue a map of the same stand, or give the start with --start X,Y,YAW (m, m, degrees) or "
        "--start last",
    )


def _truth_of(uri: str) -> Truth:
    """Return the ground truth of the source with this URI, with only its trees; an empty `Truth` if it has
    none or the source cannot be opened. Nothing is raised."""
    try:
        with closing(open_source(uri, SourceOptions())) as source:
            known = source.truth()
    except StemmapError:
        return Truth()
    return Truth(known.trees if known else None)
