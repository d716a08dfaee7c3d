"""Merges two finished runs of one stand into one map, with the correspondence of their trees."""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from app.batch.run_folder import check_folder, read_run_record, read_seen_area
from app.batch.saved_run import SavedRun, read_saved_run
from app.batch.summary import RunHealth, RunTotals, breaks_of, driven
from app.common.text import changed_values, version
from app.extensions.maps.continue_map import PAUSE_NS
from app.extensions.maps.merged_map import MergedMap, merge_maps
from pipeline.config import Parameters
from pipeline.errors import StemmapError
from pipeline.geometry.poses import Pose2
from pipeline.io.checkpoints.saved_map import SavedMap
from pipeline.io.result_files import DETECTION_COLUMNS, RunFiles, csv_text, seen_text, terrain_text
from pipeline.loop_closure.stem_matching import MapStems, Match, find_constellation
from pipeline.types.records import Path, Trees

CORRESPONDENCE_COLUMNS = ("tree", "tree_a", "tree_b", "distance_m")
HYPOTHESES = 3_000_000


@dataclass(frozen=True, slots=True, eq=False)
class MergeResult:
    """Numbers of confirmed trees of the merged map: in run a, in run b and in both; and the match of the two
    maps."""

    a: int
    b: int
    both: int
    match: Match


def merge_runs(
    folder_a: FilePath,
    folder_b: FilePath,
    out: FilePath,
    parameters: Parameters | None,
    *,
    force: bool,
    match: Match | None = None,
) -> MergeResult:
    """Merge run b into run a, and write the files of a run and correspondence.csv; seen.csv only if both runs
    have it. Scores of run a are not part of the result.

    Args:
        folder_a, folder_b: Folders of finished runs.
        out: Folder for the files.
        parameters: Parameters of the merged map; None for those of run a.
        force: Whether the map of another source may be overwritten.
        match: Where run b is in run a, with a pose; None finds it by the stems.

    Returns:
        Numbers of confirmed trees, and the match of the maps.

    Raises:
        StemmapError: A run cannot be read or has repairs, the two maps do not match with confidence, or `out`
            has the map of another source.
        OSError: The folder cannot be written; it is unchanged then.
    """
    a, b = read_saved_run(folder_a), read_saved_run(folder_b)
    chosen = a.chosen_parameters() if parameters is None else parameters
    record = read_run_record(folder_a)
    check_unrepaired(folder_a)
    check_unrepaired(folder_b)
    check_folder(out, a.sources[0].digest, force=force)
    trees_a, trees_b = a.map.trees(chosen), b.map.trees(b.chosen_parameters())
    if match is None:
        match = find_constellation(
            MapStems.of_trees(trees_b),
            MapStems.of_trees(trees_a),
            chosen.relocalisation,
            hypotheses=HYPOTHESES,
        )
    if match.pose is None:
        raise StemmapError(
            f"the two maps do not match with confidence: {match.reason} "
            f"({len(match.local)} stems agree, {match.second} in another pose)",
            where=str(folder_b),
            remedy="Merge runs that share more trees, or map the second one with --continue and --start",
        )
    shift = 0 if b.start_ns > a.map.stamp_ns[-1] else int(a.map.stamp_ns[-1]) + PAUSE_NS - b.start_ns
    merged = merge_maps(a.map, b.map, match.pose, match.covariance, shift, chosen)
    saved = _joined(a, b, merged, match, shift, chosen)
    with RunFiles(out, folder_a) as files:
        files.add_rows(_moved_rows(folder_b / "detections.csv", match.pose, len(a.map.stamp_ns), shift, a, b))
        trees = merged.map.trees(chosen)
        path = _path(merged)
        _update(record, saved, path, int(np.count_nonzero(trees.confirmed)), match)
        table = _correspondence(merged, b.map, _shown(trees), _shown(trees_a), _shown(trees_b))
        more = {
            "correspondence.csv": csv_text(CORRESPONDENCE_COLUMNS, table),
            "terrain.csv": terrain_text(merged.map.ground.record),
        }
        seen_a, seen_b = read_seen_area(folder_a), read_seen_area(folder_b)
        if seen_a is not None and seen_b is not None:
            more["seen.csv"] = seen_text(seen_a.joined(seen_b, match.pose))
        files.finish(trees, path, a.start_ns, record, saved.as_bytes(), more)
    both = sum(1 for row in table if row[1] and row[2])
    return MergeResult(sum(1 for row in table if row[1]), sum(1 for row in table if row[2]), both, match)


def check_unrepaired(folder: FilePath) -> None:
    """Refuse a run with repairs: its saved state, which is merged, is without them.

    Raises:
        StemmapError: The run has repairs, or its run.json is damaged.
    """
    if read_run_record(folder).get("repairs"):
        raise StemmapError(
            "its map has repairs, and a merged map would lose them",
            where=str(folder),
            remedy="Map the run again without --repairs, merge, and repair the merged map",
        )


def _joined(
    a: SavedRun, b: SavedRun, merged: MergedMap, match: Match, shift: int, parameters: Parameters
) -> SavedRun:
    """Return the saved state of the merged run, with preset, seed and start time of run a. Scan numbers,
    times and poses of the sources of b are those in run a; their start "origin" becomes "merged", and where
    none of their stems agreed, `stems` is the number of stems of the match.

    Args:
        a, b: The runs.
        merged: Merged map of the two runs.
        match: Pose of the map of b in that of a.
        shift: Offset that is added to the times of run b [ns].
        parameters: Parameters of the merged map.
    """
    scans, pose = len(a.map.stamp_ns), match.pose or Pose2()
    moved = []
    for source in b.sources:
        at = pose @ Pose2(*source.pose)
        moved.append(
            replace(
                source,
                from_scan=source.from_scan + scans,
                start="merged" if source.start == "origin" else source.start,
                pose=(at.x, at.y, at.yaw),
                stems=source.stems or len(match.local),
                stamp_shift_ns=source.stamp_shift_ns + shift,
            )
        )
    tally = RunTotals(
        a.tally.warned + b.tally.warned,
        a.tally.points + b.tally.points,
        a.tally.verdicts + b.tally.verdicts,
        RunHealth.of_both(a.tally.health, b.tally.health, scans, shift),
    )
    return replace(
        a,
        sources=(*a.sources, *moved),
        parameters=parameters.model_dump_json(),
        tally=tally,
        losses=dict(Counter(a.losses) + Counter(b.losses)),
        map=merged.map,
    )


def _path(merged: MergedMap) -> Path:
    """Return the path of a merged map: that of run a, then that of run b."""
    m = merged.map
    poses = m.slam.path.poses()
    return Path(m.stamp_ns, poses[:, 0], poses[:, 1], poses[:, 2], m.sigma_xy)


def _update(record: dict[str, Any], saved: SavedRun, path: Path, trees: int, match: Match) -> None:
    """Change the record of run a to that of the merged run, in place. The scores become None, `continued` a
    list of all sources but the first, and `merged` a dict of the match with `stems`, `second`,
    `log10_false_alarms` and `sigma_m_m_rad`, standard deviations of x [m], y [m] and yaw [rad].

    Args:
        record: Content of run.json of run a.
        saved: The merged run.
        path: Path of the merged run.
        trees: Number of confirmed trees of the merged run.
        match: How b was matched to a.
    """
    first, *others = saved.sources
    seconds, metres = driven(path, breaks_of(saved.sources))
    record["source"].update(uri=first.uri, sha256=first.digest)
    record.update(
        stemmap=version(),
        parameters=json.loads(saved.parameters),
        changed=changed_values(saved.preset, saved.chosen_parameters()),
        scans=len(path.stamp_ns),
        duration_s=round(seconds, 6),
        distance_m=round(metres, 3),
        trees=trees,
        points=dict(saved.tally.points),
        health=saved.tally.health.record(saved.start_ns),
        verdicts=dict(sorted(saved.tally.verdicts.items())),
        evaluation=None,
        path_error=None,
        warnings=saved.tally.warnings(),
        losses=saved.losses,
        continued=[asdict(other) for other in others],
        merged={
            "stems": len(match.local),
            "second": match.second,
            "log10_false_alarms": round(match.false_alarms, 2),
            "sigma_m_m_rad": [round(float(s), 5) for s in np.sqrt(np.diag(match.covariance))],
        },
    )


def _shown(trees: Trees) -> set[int]:
    """Return the numbers of the confirmed trees, which the files contain."""
    return set(trees.number[trees.confirmed].tolist())


def _correspondence(
    merged: MergedMap, b: SavedMap, shown: set[int], of_a: set[int], of_b: set[int]
) -> list[list[str]]:
    """Return rows of CORRESPONDENCE_COLUMNS for the confirmed trees of the merged map, ordered by number,
    which for a tree of a is that of a. The cell of a run in which the tree was not confirmed is empty, and
    the distance unless it was confirmed in both; of several trees of b that became one tree, the last is
    written.

    Args:
        merged: The merged map.
        b: Map of run b.
        shown: Numbers of the confirmed trees of the merged map.
        of_a, of_b: Numbers of the confirmed trees of the two runs.
    """
    rows = {n: [str(n), str(n) if n in of_a else "", "", ""] for n in sorted(shown)}
    merged_rows = zip(
        b.tracks.number.tolist(), merged.number_of.tolist(), merged.distance.tolist(), strict=True
    )
    for old, new, distance in merged_rows:
        if new in rows and old in of_b:
            rows[new][2] = str(old)
            rows[new][3] = "" if math.isnan(distance) or not rows[new][1] else f"{distance:.3f}"
    return list(rows.values())


def _moved_rows(
    file: FilePath, T: Pose2, scans: int, shift: int, a: SavedRun, b: SavedRun
) -> list[list[str]]:
    """Return the detections of run b as cells of DETECTION_COLUMNS, with positions, scan numbers and times
    moved into run a.

    Args:
        file: Table of the detections of run b.
        T: Pose of the frame of b in that of a.
        scans: Number of scans of run a.
        shift: Offset that is added to the times of run b [ns].
        a, b: The two runs.

    Raises:
        StemmapError: The table cannot be read or is damaged.
    """
    seconds = (b.start_ns + shift - a.start_ns) * 1e-9
    try:
        with file.open(encoding="utf-8", newline="") as text:
            header, *rows = csv.reader(text)
        if tuple(header) != DETECTION_COLUMNS:
            raise ValueError
        at = T.apply(np.array([[float(row[2]), float(row[3])] for row in rows]).reshape(len(rows), 2))
        return [
            [str(int(row[0]) + scans), f"{float(row[1]) + seconds:.3f}", f"{x:.3f}", f"{y:.3f}", *row[4:]]
            for row, (x, y) in zip(rows, at.tolist(), strict=True)
        ]
    except (OSError, ValueError, IndexError, csv.Error):
        raise StemmapError(
            "its detections cannot be read", where=str(file), remedy="Map the run again"
        ) from None
