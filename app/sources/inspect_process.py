"""Child process that inspects files from outside: `python -m app.sources.inspect_process`.

It reads one question as JSON from stdin and writes one answer as JSON to stdout. A damaged or hostile file
can affect only this process and not the server.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from app.sources.request import LONGEST_URI
from pipeline.errors import StemmapError

HYPOTHESES = 1_000_000


def recording(question: dict[str, Any]) -> dict[str, Any]:
    """Return a description of a recording, which is recognised by its contents."""
    from pipeline.io.readers import open_source

    with closing(open_source(question["path"])) as source:
        about = source.description
        return {
            "kind": about.kind,
            "scans": about.scans,
            "odometry": about.has_odometry,
            "warnings": list(about.warnings)[:20],
        }


def inside(question: dict[str, Any]) -> dict[str, Any]:
    """Return the topics of a source with their roles, and the mounting of the LiDAR."""
    from app.robot.address import is_live
    from app.sources.inspect import heard, recorded

    return (heard if is_live(question["path"]) else recorded)(question["path"])


def finished(question: dict[str, Any]) -> dict[str, Any]:
    """Return map and figures of a folder that `stemmap map` wrote."""
    import numpy as np

    from app.batch.run_folder import read_run, read_run_record
    from app.dashboard.payload import tree_rows
    from app.dashboard.run_recorder import thinned

    folder = Path(question["path"])
    run, record = read_run(folder), read_run_record(folder)
    path_xy = np.stack([run.path.x, run.path.y], axis=1)
    trees = tree_rows(run.trees, 0)
    return {
        "uri": run.uri,
        "kind": str(record["source"].get("kind", ""))[:200],
        "source": str(record["source"].get("sha256") or "")[:200],
        "odometry": str(record.get("odometry") or "auto")[:LONGEST_URI],
        "seed": run.seed,
        "chosen": record.get("chosen"),
        "scans": int(record.get("scans") or 0),
        "time_s": float(record.get("duration_s") or 0.0),
        "distance_m": float(np.hypot(*np.diff(path_xy, axis=0).T).sum()) if len(path_xy) else 0.0,
        "trees": len(trees),
        "preset": str(record.get("preset", ""))[:100],
        "parameters": run.parameters.flat(),
        "scores": _scores(record.get("evaluation")),
        "map": {"trees": trees, "path": thinned(path_xy), "truth": None},
    }


def laid(question: dict[str, Any]) -> dict[str, Any]:
    """Return the pose of one map in another, found by stem matching."""
    import numpy as np

    from pipeline.config import preset
    from pipeline.loop_closure.stem_matching import Stems, find_constellation

    def stems(rows: list[list[float | None]]) -> Stems:
        columns = np.array(rows, np.float64).reshape(-1, 5)
        return Stems(columns[:, :2], columns[:, 2], columns[:, 3], columns[:, 4])

    match = find_constellation(
        stems(question["local"]),
        stems(question["reference"]),
        preset("forest").relocalisation,
        hypotheses=HYPOTHESES,
    )
    pose = match.pose
    return {
        "pose": None if pose is None else [pose.x, pose.y, pose.yaw],
        "reason": match.reason or "",
        "stems": len(match.local),
    }


QUESTIONS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "recording": recording,
    "inside": inside,
    "finished": finished,
    "laid": laid,
}


def answer(text: str) -> dict[str, Any]:
    """Return the answer to a question, or an error message."""
    question = json.loads(text)
    try:
        return {"answer": QUESTIONS[question["ask"]](question)}
    except StemmapError as error:
        return {"error": {"what": error.what, "where": error.where, "remedy": error.remedy}}
    except MemoryError:
        return {"error": {"what": "it does not fit into the memory of this machine"}}


def _scores(evaluation: object) -> dict[str, Any] | None:
    """Return the scores from run.json as the page shows them."""
    if not isinstance(evaluation, dict):
        return None
    known = {name: _number(value) for name, value in evaluation.items()}
    rates = {}
    for name in ("TA", "TR", "FA", "FR"):
        given = evaluation.get(name)
        count, of = (
            (_number(given.get(k)) or 0 for k in ("count", "of")) if isinstance(given, dict) else (0, 0)
        )
        rates[name] = {"count": count, "of": of, "rate": count / of if of else None}
    scaled = {"position_rmse_m": 1.0, "position_bias_m": 1.0, "dbh_rmse_cm": 100.0, "dbh_bias_cm": 100.0}
    told: dict[str, Any] = {**rates}
    for name, factor in scaled.items():
        value = known.get(name.rpartition("_")[0])
        told[name] = None if value is None else factor * value
    for name in (
        "spurious",
        "completeness",
        "correctness",
        "f1",
        "dbh_count",
        "mean_pair_error_percent",
        "largest_pair_error_percent",
    ):
        told[name] = known.get(name)
    return {**told, "reach_m": known.get("reach")}


def _number(value: object) -> float | int | None:
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def main() -> None:
    """Answer one question."""
    outgoing = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # libraries may print
    told = json.dumps(answer(sys.stdin.read()), allow_nan=False)
    outgoing.write(told)
    outgoing.flush()
    os._exit(0)  # there is nothing to save


if __name__ == "__main__":
    main()
