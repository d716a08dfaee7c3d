"""Maps a run from its first to its last scan, in this process, and writes its files to a folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np

from app.batch.run_folder import as_written, read_seen_area, recorded_time, score_map
from app.batch.saved_run import (
    FORMAT,
    EarlierRun,
    RunStart,
    SavedRun,
    at_origin,
)
from app.batch.summary import (
    breaks_of,
    driven,
    far_truth,
    left_out_warning,
    start_lines,
    summary_lines,
    unconfirmed_warning,
    unread_scans,
)
from app.batch.tree_pictures import FOLDER as PICTURES
from app.batch.tree_pictures import keep_pictures
from app.common.text import changed_values, count, preset_words, version
from app.common.timers import Stopwatch
from app.sources.request import ChosenOdometry, with_odometry
from app.store.forests import mapper_of
from pipeline.config import Parameters
from pipeline.errors import SourceError, StemmapError
from pipeline.evaluation import MapScores, PathError, path_error
from pipeline.ground.scan_ground import NO_GROUND
from pipeline.io.checkpoints.saved_map import SavedMap
from pipeline.io.readers.base import Source
from pipeline.io.readers.ros import RosSource
from pipeline.io.result_files import ODOMETRY, RunFiles, seen_text, terrain_text, tum_text
from pipeline.jit import on_compiling
from pipeline.loop_closure.correction import DOUBLED, NOT_FOUND
from pipeline.map_faults import DOUBTFUL, fault_of_short_run
from pipeline.mapper import Mapper
from pipeline.odometry.lidar_odometry import LOST
from pipeline.odometry.odometry_override import OdometryOverride
from pipeline.repairs.record import Repair, repairs_record, repairs_words, unapplied
from pipeline.repairs.repaired import MapOfRun, Repairer
from pipeline.seen_area import SeenArea, SeenRecorder, ViewSelection
from pipeline.slam.slip_detection import SLIPPED
from pipeline.types.records import Frame, Path, Step, Trees, Truth, TruthTrees

MEASURED_SCANS = 100_000  # whose times enter the medians
#: First words of the warnings after which a map is not to be trusted.
WRONG = (DOUBTFUL, DOUBLED, LOST, NOT_FOUND)


@dataclass(frozen=True, slots=True, eq=False)
class OfflineRun:
    """A run to be mapped.

    Attributes:
        source: The source, without a choice of the odometry.
        preset, parameters: Name of the preset, and all parameters at the start.
        seed: Random seed.
        odometry: Source of the motion, see `app.sources.request`.
        truth_trees: True trees that replace those of the source; None for these.
        earlier: The run whose map this run goes on with; None begins a map.
        stop_after: Maximum number of scans; None for all.
        revisions: Changes of parameters, ascending: index of the first scan, and all parameters from there
            on.
        on_frame: Called with the results of each scan.
        chosen: Topics and mounting that the user chose, see `SourceRequest.kept_choices`.
        repairs: Repairs that are applied to the map after the last scan. detections.csv and the state for a
            continuation are without them.
    """

    source: Source
    preset: str
    parameters: Parameters
    seed: int
    odometry: str
    truth_trees: TruthTrees | None = None
    earlier: EarlierRun | None = None
    stop_after: int | None = None
    revisions: tuple[tuple[int, Parameters], ...] = ()
    on_frame: Callable[[Frame, Mapper], None] | None = None
    chosen: dict[str, Any] | None = None
    repairs: tuple[Repair, ...] = ()


@dataclass(slots=True, eq=False)
class MappingResult:
    """The result of a mapping command, for people.

    Attributes:
        summary: Lines to print.
        warnings: Each warning once, see `warning_texts`.
        losses: Dict from a reason to the number of messages or points that were left out for it.
        scan_ms: Median time of a scan without compilation [ms]; 0 if none was measured.
        stage_ms: Dict from each stage to its median time without compilation [ms].
    """

    summary: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    losses: dict[str, int] = field(default_factory=dict)
    scan_ms: float = 0.0
    stage_ms: dict[str, float] = field(default_factory=dict)


def map_run(plan: OfflineRun, folder: FilePath) -> MappingResult:
    """Map a run, write its files, and return the result for people. The source stays open. Pictures of trees
    are written at the end, if the source has a camera and a map was begun; their errors are warnings.

    Args:
        plan: The run.
        folder: Folder for the files; those of an earlier run are replaced.

    Raises:
        StemmapError: The source cannot be read or has no scan, the odometry is not available, or the start in
            an earlier map was not found, or its seen.csv is damaged.
        OSError: The folder cannot be written; it is unchanged then.
    """
    stopwatch = Stopwatch(scans=MEASURED_SCANS)
    earlier = None if plan.earlier is None else plan.earlier.folder
    with RunFiles(folder, earlier) as files, on_compiling(stopwatch.disturb):
        outcome, mapped = _map(plan, files, stopwatch, earlier)
    if plan.earlier is None:  # the path of an earlier drive has no pictures here
        _keep_pictures(mapped, folder, outcome)
    return outcome


class _Mapped(NamedTuple):
    """Input for the pictures of trees, which are made after the map is written."""

    source: Source
    trees: Trees
    path: Path


def _map(
    plan: OfflineRun,
    files: RunFiles,
    stopwatch: Stopwatch,
    earlier: FilePath | None,
) -> tuple[MappingResult, _Mapped]:
    """Map the run and finish its files; return the result and the input of the pictures. Errors as in
    `map_run`.

    Args:
        plan: As in `map_run`.
        earlier: Folder of the run whose map it goes on with; None for none.
        files: Output files.
        stopwatch: Measures the stages.
    """
    recorded = plan.source
    moving, chosen = with_odometry(recorded, plan.odometry)
    plan = replace(plan, source=moving)
    description = plan.source.description
    mapper = mapper_of(description, plan.parameters, plan.seed, stopwatch)
    begun = _beginning(plan, mapper, chosen)
    left_out = Counter[str]()
    to_map = begun.steps(plan.source, chosen.steps, left_out)
    seen = SeenRecorder()
    frame, start_ns = _map_scans(plan, mapper, begun, islice(to_map, plan.stop_after), files, stopwatch, seen)
    tally = begun.tally
    mapped = MapOfRun(
        replace(frame, ground=mapper.height_map), mapper.path, mapper.graph, mapper.tree_landmarks
    )
    repaired = Repairer().repaired(mapped, plan.repairs)
    frame, path, truth = repaired.frame, repaired.path, _truth(plan, begun)
    evaluation = None
    if truth.trees is not None:
        evaluation = score_map(*as_written(frame.trees, path, start_ns), truth.trees, plan.parameters)
    error = path_error(path, truth.path) if truth.path else None
    counted = begun.losses + left_out + Counter(plan.source.losses)
    losses = {reason: n for reason, n in counted.items() if n}
    state = _saved(plan, begun, mapper, start_ns, losses).as_bytes()
    if evaluation is not None and evaluation.TA.of + evaluation.TR.of == 0:
        tally.warned[far_truth(evaluation.reach)] += 1
    is_slipping = any(DOUBTFUL in text and SLIPPED in text for text in tally.warned)
    if is_slipping and isinstance(recorded, RosSource) and (wrong := recorded.contradiction_of_mounting()):
        tally.warned[wrong] += 1
    if unconfirmed := unconfirmed_warning(frame, plan.parameters):
        tally.warned[unconfirmed] += 1
    if left_out_words := left_out_warning(losses, frame.index + 1):
        tally.warned[left_out_words] += 1
    if not any(DOUBTFUL in text for text in tally.warned):
        is_empty = 0 < tally.points["returns"] == tally.points["out of range"]
        if fault := fault_of_short_run(frame.index + 1, tally.warned[NO_GROUND], is_empty=is_empty):
            tally.warned[fault] += 1
    seconds, metres = driven(path, breaks_of(begun.sources))
    record = _run_record(plan, begun, frame, (seconds, metres), start_ns, evaluation, error, losses)
    record["odometry_used"] = chosen.words
    if plan.repairs:
        record["repairs"] = repairs_record(plan.repairs, repaired.problems)
        record["warnings"] = [*record["warnings"], *unapplied(plan.repairs, repaired.problems)]
    outcome = MappingResult(
        summary=[
            *summary_lines(description.uri, frame, (seconds, metres), evaluation, error),
            f"odometry: {chosen.words}",
            *unread_scans(description.topics),
            preset_words(plan.preset, plan.parameters),
            *([repairs_words(plan.repairs, repaired.problems)] if plan.repairs else []),
            *start_lines(begun.sources[-1]),
            *tally.health.summary(),
        ],
        warnings=[*tally.warnings(), *unapplied(plan.repairs, repaired.problems)],
        losses=losses,
        scan_ms=stopwatch.scan_ms,
        stage_ms=stopwatch.stage_ms,
    )
    further = {
        "terrain.csv": terrain_text(frame.ground or mapper.height_map),
        "seen.csv": seen_text(_observed(seen.area(path), earlier)),
    }
    if isinstance(moving, OdometryOverride) and (poses := moving.lidar_poses):
        further[ODOMETRY] = tum_text(poses)
    files.finish(frame.trees, path, start_ns, record, state, further)
    return outcome, _Mapped(plan.source, frame.trees, path)


def _map_scans(
    plan: OfflineRun,
    mapper: Mapper,
    begun: RunStart,
    to_map: Iterable[Step],
    files: RunFiles,
    stopwatch: Stopwatch,
    seen: SeenRecorder,
) -> tuple[Frame, int]:
    """Map all scans and write their detections; return the last frame and the time of the first scan [ns].

    Args:
        plan: The run; its revisions are applied, and its `on_frame` is called after each scan.
        mapper: The mapper.
        begun: How the run begins; its tally is updated.
        to_map: Steps of the scans.
        files: Output files.
        stopwatch: Measures the stages.
        seen: Recorder to which the views of the scans are added.

    Raises:
        SourceError: There is no scan that is not in the map yet.
    """
    start_ns, frame = begun.start_ns, None
    views = ViewSelection()
    for step in to_map:
        _use_revisions(plan, mapper, step.index)
        # The first scan loads the kernels, which takes much longer than mapping.
        with stopwatch.aside() if frame is None else stopwatch.whole_scan():
            scan = mapper.segment(step)
            frame = mapper.process(step, scan)
        if plan.on_frame is not None:
            plan.on_frame(frame, mapper)
        if views.take(frame.estimate.T_map_base):
            seen.add(frame.stamp_ns, scan.view)
        start_ns = frame.stamp_ns if start_ns is None else start_ns
        files.add(frame, start_ns)
        begun.tally.add(frame)
    if frame is None or start_ns is None:
        mapped = " that was not mapped yet" if begun.scans else ""
        raise SourceError(f"there is no scan in it{mapped}", where=plan.source.description.uri)
    return frame, start_ns


def _observed(area: SeenArea, earlier: FilePath | None) -> SeenArea:
    """Return the observed area joined with that of the run in `earlier`; `area` itself if `earlier` is None
    or has no seen.csv. Raises SourceError if seen.csv is damaged."""
    before = None if earlier is None else read_seen_area(earlier)
    return area if before is None else before.joined(area)


def _keep_pictures(mapped: _Mapped, folder: FilePath, outcome: MappingResult) -> None:
    """Write the pictures of trees to the folder, and their number to the summary of the outcome. The map is
    complete already, so errors and Ctrl-C become warnings of the outcome.

    Args:
        mapped: Source and map.
        folder: Folder of the run.
        outcome: Result for people, which is changed.
    """
    try:
        kept, warning = keep_pictures(mapped.source, mapped.trees, mapped.path, folder)
    except (StemmapError, OSError) as error:
        kept, warning = 0, f"some pictures of trees are missing: {error}"
    except KeyboardInterrupt:
        kept, warning = 0, "some pictures of trees are missing because of Ctrl-C; the map is complete"
    if kept:
        outcome.summary.append(f"{count(kept, 'picture')} of trees in {folder / PICTURES}")
    if warning:
        outcome.warnings.append(warning)


def _use_revisions(plan: OfflineRun, mapper: Mapper, scan: int) -> None:
    """Give the mapper the parameters in force at a scan, if a revision changed them; nothing before the first
    revision.

    Args:
        plan: The run with its revisions.
        mapper: The mapper, whose parameters may be changed.
        scan: Index of the scan.
    """
    in_force = [parameters for first, parameters in plan.revisions if first <= scan]
    if in_force and in_force[-1] is not mapper.parameters:
        mapper.parameters = in_force[-1]


def _changes(plan: OfflineRun) -> list[dict[str, Any]]:
    """Return the revisions of the parameters as a list of dicts with `revision` (number), `from_scan` and
    `changes`, a dict from dotted names to the values that differ from the revision before. The first revision
    has the number 0, begins with scan 0 and has no changes. Later revisions without a change are omitted."""
    revisions: list[dict[str, Any]] = [{"revision": 0, "from_scan": 0, "changes": {}}]
    before = plan.parameters
    for first, parameters in plan.revisions:
        if changes := parameters.changes_from(before):
            revisions.append({"revision": len(revisions), "from_scan": first, "changes": changes})
        before = parameters
    return revisions


def _beginning(plan: OfflineRun, mapper: Mapper, chosen: ChosenOdometry) -> RunStart:
    """Return how the run begins. The warnings of source and odometry are counted in its tally, except if the
    drive of an earlier map is resumed.

    Args:
        plan: The run.
        mapper: A mapper before its first scan; an earlier map is loaded into it.
        chosen: Selected source of the motion.

    Raises:
        StemmapError: The start in an earlier map was not found, or the source cannot be read.
    """
    warned = (chosen.warning,) if chosen.warning else ()
    warnings = [*warned, *plan.source.description.warnings]
    if plan.earlier is None:
        return at_origin(plan.source, warnings)
    return plan.earlier.begin(plan.source, mapper, chosen.steps, plan.seed, warnings)


def _saved(
    plan: OfflineRun, begun: RunStart, mapper: Mapper, start_ns: int, losses: dict[str, int]
) -> SavedRun:
    """Return the state after the last scan.

    Args:
        plan: The run.
        begun: Sources and totals.
        mapper: The mapper after the last scan.
        start_ns: Time of the first scan [ns].
        losses: Dict from a reason to the number of records that were left out for it.
    """
    return SavedRun(
        FORMAT,
        begun.sources,
        plan.preset,
        plan.parameters.model_dump_json(),
        plan.seed,
        start_ns,
        begun.tally,
        losses,
        SavedMap.of(mapper),
    )


def _truth(plan: OfflineRun, begun: RunStart) -> Truth:
    """Return the ground truth in the frame of the map: the trees of the plan, else those of the source, and
    the path of the source; None in place of unknown trees or an unknown path. For another drive in an
    earlier map, the source is the first one of the map, and the path is None."""
    known = begun.truth or plan.source.truth() or Truth()
    return Truth(plan.truth_trees or known.trees, known.path)


def _run_record(
    plan: OfflineRun,
    begun: RunStart,
    frame: Frame,
    driven_s_m: tuple[float, float],
    start_ns: int,
    evaluation: MapScores | None,
    error: PathError | None,
    losses: dict[str, int],
) -> dict[str, Any]:
    """Return the content of run.json except `odometry_used` as a dict. It has no times of computation.

    The keys are `stemmap` (version); `source`, a dict with `uri` and `sha256` of the first drive and `kind`
    and `sensor` of the present one; `continued`, a list of the further drives, and `chosen`, both only if
    there are any; `recorded`, see `recorded_time`; `seed`, `odometry`, `preset`, `changed` and `parameters`;
    `revisions`, see `_changes`; the numbers `scans`, `duration_s`, `distance_m` and `trees`; `points` and
    `verdicts`, dicts of counts; `health`, see `RunHealth.record`; `evaluation` and `path_error`, dicts, None
    if there is no ground truth; `warnings` and `losses`.

    Args:
        plan: The run with its parameters.
        begun: Sources so far, and the running totals.
        frame: The last frame.
        driven_s_m: Duration [s] and length [m] of the path.
        start_ns: Time of the first scan [ns].
        evaluation, error: Scores of map and path; None if there is no ground truth.
        losses: Dict from a reason to the number of records that were left out for it.
    """
    description, tally = plan.source.description, begun.tally
    first, *others = begun.sources
    return {
        "stemmap": version(),
        "source": {
            "uri": first.uri if others else description.uri,
            "kind": description.kind,
            "sha256": first.digest if others else description.digest,
            "sensor": asdict(description.sensor),
        },
        **({"continued": [asdict(other) for other in others]} if others else {}),
        **recorded_time(description.kind, start_ns),
        "seed": plan.seed,
        "odometry": plan.odometry,
        **({} if plan.chosen is None else {"chosen": plan.chosen}),
        "preset": plan.preset,
        "changed": changed_values(plan.preset, plan.parameters),
        "parameters": plan.parameters.model_dump(),
        "revisions": _changes(plan),
        "scans": frame.index + 1,
        "duration_s": round(driven_s_m[0], 6),
        "distance_m": round(driven_s_m[1], 3),
        "trees": int(np.count_nonzero(frame.trees.confirmed)),
        "points": dict(tally.points),
        "health": tally.health.record(start_ns),
        "verdicts": dict(sorted(tally.verdicts.items())),
        "evaluation": None if evaluation is None else asdict(evaluation),
        "path_error": None if error is None else asdict(error),
        "warnings": tally.warnings(),
        "losses": losses,
    }
