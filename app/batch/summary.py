"""What came of a run, as lines for people."""

from __future__ import annotations

import numpy as np

from app.batch.saved_run import RunSource
from app.common.text import count
from pipeline.evaluation import Evaluation, PathError, Rate
from pipeline.types.records import Frame


def summary_lines(
    uri: str,
    frame: Frame,
    driven_s_m: tuple[float, float],
    evaluation: Evaluation | None,
    error: PathError | None,
) -> list[str]:
    """What came of a run, its scores where there is a truth.

    Args:
        uri: Of the source; frame: its last.
        driven_s_m: How long [s] and how far [m] the robot drove.
        evaluation, error: Of trees and path, where a truth is known.
    """
    seconds, metres = driven_s_m
    trees = int(np.count_nonzero(frame.trees.confirmed))
    scans = count(frame.index + 1, "scan")
    told = int(np.count_nonzero(frame.trees.confirmed & np.isfinite(frame.trees.dbh)))
    mapped = f"{count(trees, 'tree')}, {told} of them with a DBH"
    lines = [f"{uri}: {scans}, {seconds:.1f} s, {metres:.1f} m driven, {mapped}"]
    if evaluation is not None:
        lines += evaluation_lines(evaluation)
    if error is not None:
        how = "after alignment" if error.aligned else "in the frame of the map"
        lines.append(
            f"path: RMS {error.rms:.3f} m, median {error.median:.3f} m, largest {error.largest:.3f} m "
            f"({count(error.compared, 'true position')}, {how})"
        )
    return lines


def evaluation_lines(e: Evaluation, *, whole: bool = False) -> list[str]:
    """The scores as lines for people, counts beside the rates; `whole` where nobody drove, so that all of the
    truth was asked for."""
    where = "in the whole cloud" if whole else f"within {e.reach:g} m of the path"
    return [
        f"trees found (TA) {_rate(e.TA)}, missed (FR) {_rate(e.FR)} {where}",
        f"other things left out (TR) {_rate(e.TR)}, taken for trees (FA) {_rate(e.FA)}; "
        f"{count(e.spurious, 'tree')} where nothing stands",
        f"completeness {_percent(e.completeness)}   correctness {_percent(e.correctness)}   "
        f"F1 {_percent(e.f1)}",
        f"position RMSE {_metres(e.position_rmse)}   DBH RMSE {_metres(e.dbh_rmse)} "
        f"({count(e.dbh_count, 'tree')})   mean pair error {_pair(e.mean_pair_error_percent)}",
        *([f"warning: {truth_in_doubt(e)}"] if e.is_doubtful else []),
    ]


def truth_in_doubt(e: Evaluation) -> str:
    """What a person is asked where the truth may be of another forest; empty where nothing says so."""
    if not e.is_doubtful:
        return ""
    few = f"only {e.TA.count}" if e.TA.count else "none"
    lie = "lies" if e.TA.count <= 1 else "lie"
    return (
        f"{few} of {count(e.TA.of, 'true tree')} {lie} near a mapped one: is this the truth of this forest, "
        "in the map's frame?"
    )


def _rate(rate: Rate) -> str:
    return f"{rate.count}/{rate.of} ({_percent(rate.rate)})"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f} %"


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f} cm"


def _pair(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} %"


def start_lines(last: RunSource) -> list[str]:
    """Where a run that goes on in an earlier map was found to start."""
    if last.start != "constellation":
        return []
    x, y, yaw = last.pose
    return [
        f"started at {x:.2f}, {y:.2f} m, {np.degrees(yaw):.1f} degrees of the map: {last.stems} stems agree"
    ]
