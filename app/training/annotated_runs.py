"""Runs that people annotated: mapped once more, as they were mapped then, to gather examples of what was
judged."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from app.common.version import version
from app.robot.source import LiveSource
from app.sources.opening import open_any, with_odometry
from app.sources.request import SourceRequest
from app.store.records import Content
from app.store.store import AnnotatedSource
from app.training.annotated import REACH, SEEN, Judged
from app.training.fit_forest import Examples
from app.training.keeping import kept_or_made
from pipeline.classification.features import NAMES
from pipeline.classification.forest import PACKAGE
from pipeline.config import PRESETS, Parameters, preset
from pipeline.errors import ParameterError, SourceError
from pipeline.mapper import Mapper
from pipeline.odometry.synchroniser import steps

Progress = Callable[[str], None]

EVERY_SCANS = 50  # between two words on how far it is


@dataclass(frozen=True, slots=True)
class AnnotatedRun:
    """A run that people annotated, and how it was mapped then.

    Attributes:
        name, digest: Of its source.
        request: Source, odometry, seed, topics and mounting with which it was mapped.
        parameters: That it was mapped with.
        annotations: In the frame of its map.
    """

    name: str
    digest: str
    request: SourceRequest
    parameters: Parameters
    annotations: tuple[Content, ...]


def annotated_run(source: AnnotatedSource) -> AnnotatedRun:
    """A source of the store with the parameters that it was mapped with, those that this version knows."""
    request = source.request
    start = preset(request.preset if request.preset in PRESETS else "forest")
    known = {name: value for name, value in request.parameters.items() if name in start.flat()}
    try:
        parameters = start.replace(known)
    except ParameterError:  # bounds that were wider once
        parameters = start
    return AnnotatedRun(source.name, source.source, request, parameters, source.annotations)


def examples_of(run: AnnotatedRun, kept: Path | None, progress: Progress) -> Examples:
    """What was gathered of each thing that was annotated: from the folder of kept examples, else the run is
    mapped once more, and what comes of it is kept there.

    Raises:
        SourceError: The run cannot be read any more, or is another one.
        StemmapError: The kept examples are damaged.
    """
    (found,) = kept_or_made(kept, _key(run), partial(_looked_through, run, progress))
    return found


def _key(run: AnnotatedRun) -> str:
    """What examples hang on: what was recorded, how it is mapped, what was said, what figures there are."""
    told = [
        run.digest,
        run.request.seed,
        run.request.odometry,
        run.request.kept_choices(),
        run.parameters.flat(),
        [[a.x, a.y, a.kind] for a in run.annotations],
        [*NAMES, *SEEN, *sorted(REACH.items())],
        version(),
    ]
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _looked_through(run: AnnotatedRun, progress: Progress) -> list[Examples]:
    request = run.request
    with closing(open_any(request.uri, request.options())) as source:
        if isinstance(source, LiveSource):
            raise SourceError(
                "a robot is not heard again", where=request.uri, remedy="Annotate its recording"
            )
        known = source.description
        if (known.digest or known.uri) != run.digest:
            raise SourceError("it is another recording than the one that was annotated", where=request.uri)
        moving, chosen = with_odometry(source, request.odometry)
        # Columns and their figures are the same whoever votes on them.
        parameters = run.parameters.replace(
            {"classification.method": "columns", "classification.forest": PACKAGE}
        )
        mapper = Mapper(
            parameters, sensor=known.sensor, T_base_lidar=known.T_base_lidar, seed=run.request.seed
        )
        judged = Judged(run.annotations)
        for step in steps(moving.records(), odometry=chosen.steps):
            judged.see(mapper.process(step).columns)
            if step.index % EVERY_SCANS == 0:
                of = f" of {known.scans:,}" if known.scans else ""
                progress(f"Looking through {run.name}: scan {step.index:,}{of}")
        return [judged.examples(run.name, all_around=known.sensor.rings > 0)]
