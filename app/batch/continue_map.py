"""How a run begins: at the origin, or in the map that another run saved."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from app.batch.run_totals import Tally
from app.batch.saved_run import RunSource, SavedRun
from app.worker.mapper_factory import mapper_of
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2
from pipeline.io.readers import SourceOptions, open_source
from pipeline.io.readers.base import Source
from pipeline.loop_closure.stem_matching import Match, Stems, find_constellation
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import OdometryChoice, steps
from pipeline.types.records import Step, Truth

Start = Literal["auto", "resume", "last"] | Pose2
GIVEN_SIGMA = (0.3, 0.3, np.radians(5.0))  # m, m, rad; how well a person can tell a pose
PAUSE_NS = 1_000_000_000  # between two runs, where the clock of the second does not follow
FIRST_TRY, NEXT_TRY = 10, 1.3  # scans, and by which factor more before it is tried again
HYPOTHESES = 1_000_000
KNOWN_ALREADY = "this very recording is in the map already: it tells nothing new, its errors count twice"


@dataclass(frozen=True, slots=True, eq=False)
class Continued:
    """A saved run to go on from, and where the robot starts in it."""

    saved: SavedRun
    start: Start


@dataclass(slots=True, eq=False)
class Beginning:
    """From where a run goes on.

    Attributes:
        tally: What was counted before; losses: by reason.
        scans: Mapped before.
        sources: All of them, this one the last.
        start_ns: Time of the first scan of all, None when there was none yet.
        after_ns: Scans up to this time were mapped before.
        stamp_shift_ns: To be added to the times of this source.
        truth: What is known of the map's frame, where this source's own truth is in another one.
    """

    tally: Tally
    scans: int = 0
    sources: tuple[RunSource, ...] = ()
    start_ns: int | None = None
    after_ns: int | None = None
    stamp_shift_ns: int = 0
    losses: Counter[str] = field(default_factory=Counter)
    truth: Truth | None = None

    def steps(self, source: Source, odometry: OdometryChoice, left_out: Counter[str]) -> Iterator[Step]:
        """The steps that are still to be mapped, numbered on."""
        index = self.scans
        for step in steps(source.records(), odometry=odometry, losses=left_out):
            stamp = step.scan.stamp_ns + self.stamp_shift_ns
            if self.after_ns is not None and stamp <= self.after_ns:
                continue
            yield replace(step, index=index, scan=replace(step.scan, stamp_ns=stamp))
            index += 1


def at_origin(source: Source, warnings: list[str]) -> Beginning:
    """The first run of a map."""
    known = source.description
    first = RunSource(known.uri, known.digest, 0, "origin", (0.0, 0.0, 0.0), 0, 0)
    return Beginning(Tally(Counter(warnings)), sources=(first,))


def go_on(
    continued: Continued,
    source: Source,
    mapper: Mapper,
    odometry: OdometryChoice,
    seed: int,
    warnings: list[str],
) -> Beginning:
    """Give a fresh mapper the saved map, and find where the robot starts in it.

    Raises:
        StemmapError: It was to be found by its stems and was not.
    """
    saved, start = continued.saved, continued.start
    path = saved.map.stamp_ns
    beginning = Beginning(
        saved.tally, len(path), saved.sources, saved.start_ns, int(path[-1]), losses=Counter(saved.losses)
    )
    if start == "resume":
        mapper.load(saved.map.state(), path, saved.map.sigma_xy, saved.map.motion)
        return _resumed(beginning, source)
    found: Match | None = None
    pose = start if isinstance(start, Pose2) else None
    covariance = np.diag(np.square(GIVEN_SIGMA))
    if start == "auto":
        found = localise(
            source, mapper.parameters, Stems.of_trees(saved.map.trees(mapper.parameters)), odometry, seed
        )
        pose, covariance = found.pose, found.covariance
    mapper.load(replace(saved.map.state(), odometry=None), path, saved.map.sigma_xy, saved.map.motion)
    if pose is None:
        end = mapper.path
        pose = Pose2(float(end.x[-1]), float(end.y[-1]), float(end.yaw[-1]))
    else:
        mapper.place(len(path), pose, covariance)
    return _in_another_run(beginning, source, start, pose, found, warnings)


def _resumed(beginning: Beginning, source: Source) -> Beginning:
    known, last = source.description, beginning.sources[-1]
    beginning.stamp_shift_ns = last.stamp_shift_ns
    if known.digest == last.digest:
        beginning.losses.clear()  # they are counted anew: the source is read from its start
        return beginning
    part = RunSource(known.uri, known.digest, beginning.scans, "resume", last.pose, 0, last.stamp_shift_ns)
    beginning.sources += (part,)
    return beginning


def _in_another_run(
    beginning: Beginning, source: Source, start: Start, pose: Pose2, found: Match | None, warnings: list[str]
) -> Beginning:  # fmt: skip
    known, after_ns = source.description, beginning.after_ns or 0
    first_ns = next((s.scan.stamp_ns for s in steps(source.records(), odometry="static")), 0)
    beginning.stamp_shift_ns = max(after_ns + PAUSE_NS - first_ns, 0) if first_ns <= after_ns else 0
    how = "given" if isinstance(start, Pose2) else "last" if start == "last" else "constellation"
    part = RunSource(
        known.uri, known.digest, beginning.scans, how, (pose.x, pose.y, pose.yaw),
        0 if found is None else len(found.local), beginning.stamp_shift_ns,
    )  # fmt: skip
    if known.digest in (part.digest for part in beginning.sources):
        beginning.tally.warned[f"{KNOWN_ALREADY} ({known.uri})"] += 1
    beginning.truth = _truth_of(beginning.sources[0].uri)
    beginning.sources += (part,)
    beginning.tally.warned.update(warnings)
    return beginning


def localise(
    source: Source, parameters: Parameters, reference: Stems, odometry: OdometryChoice, seed: int
) -> Match:
    """Where a source's first pose is in a map: its first scans are mapped apart until their stems are
    found there.

    Raises:
        StemmapError: No part of the source was found, with the reason of the last refusal.
    """
    mapper = mapper_of(source.description, parameters, seed)
    due, frame, match = float(FIRST_TRY), None, None
    for step in steps(source.records(), odometry=odometry):
        frame = mapper.process(step)
        if step.index + 1 < due:
            continue
        due = NEXT_TRY * (step.index + 1)
        match = find_constellation(
            Stems.of_trees(frame.trees), reference, parameters.relocalisation, hypotheses=HYPOTHESES
        )
        if match.pose is not None:
            return match
    if frame is not None:
        stems = Stems.of_trees(frame.trees)
        match = find_constellation(stems, reference, parameters.relocalisation, hypotheses=HYPOTHESES)
        if match.pose is not None:
            return match
    raise StemmapError(
        f"the robot was not found in the saved map: {match.reason if match else 'there is no scan'}",
        where=source.description.uri,
        remedy="Say where it starts with --start X,Y,YAW (m, m, degrees) or --start last",
    )


def _truth_of(uri: str) -> Truth:
    """The true trees of the first run, in whose frame the map is; none where it cannot be asked."""
    try:
        with closing(open_source(uri, SourceOptions())) as source:
            known = source.truth()
    except StemmapError:
        return Truth()
    return Truth(known.trees if known else None)
