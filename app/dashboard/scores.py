"""Scores of the map against the ground truth, at most three times a second.

They are computed in a thread of the web process: they need only the tree table, which is available here, take
about a millisecond, and leave the time of the worker to the mapping.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from app.batch.run_folder import score_map
from app.batch.summary import truth_in_doubt
from pipeline.config import Parameters
from pipeline.evaluation import MapScores, match, pair_distances, pair_errors
from pipeline.types.records import Path, Trees, TruthTrees

_log = logging.getLogger(__name__)

_PAUSE_S = 0.3
MOST_PAIRED = 300


class Scores:
    """Computes scores in the background; of several requests only the newest is computed.

    Args:
        tell: Called on the event loop with each score for the browsers, and with None when there is no map
            any more.

    Attributes:
        latest: The newest score, or None.
    """

    def __init__(self, tell: Callable[[dict[str, Any] | None], None]) -> None:
        self.latest: dict[str, Any] | None = None
        self._tell = tell
        self._requested: tuple[Trees, Path, TruthTrees, Parameters] | None = None
        self._task: asyncio.Task[None] | None = None
        self._runs = 0

    def ask(self, trees: Trees, path: Path, truth: TruthTrees, parameters: Parameters) -> None:
        """Request the score of a map, see `score_payload`; it replaces a request that has not begun. `tell`
        receives it, at most about three times a second. A score that fails is only logged. Arguments as in
        `score_map`."""
        self._requested = (trees, path, truth, parameters)
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._work(), name="scores")

    def forget(self) -> None:
        """Remove the score and a pending request, and call `tell` with None, because there is no map any
        more."""
        self._requested = self.latest = None
        self._runs += 1
        self._tell(None)

    def close(self) -> None:
        """Stop computing."""
        if self._task is not None:
            self._task.cancel()

    async def _work(self) -> None:
        """Compute the requested scores, with a pause after each, until none is requested. Errors are logged;
        a score of a map that is gone is dropped."""
        while self._requested is not None:
            requested, self._requested = self._requested, None
            run = self._runs
            try:
                score = await asyncio.to_thread(score_map, *requested)
            except Exception:  # a score that fails must not end those that follow
                _log.exception("the map could not be scored")
            else:
                if run == self._runs:  # else the map has gone meanwhile
                    self.latest = score_payload(score)
                    self._tell(self.latest)
            await asyncio.sleep(_PAUSE_S)


def score_payload(score: MapScores) -> dict[str, Any]:
    """Return scores as a dict of JSON values for the dashboard. `TA`, `TR`, `FA` and `FR` are dicts with
    `count`, `of` and `rate`. The other keys are fields of `MapScores`, with the unit appended to the name
    (`_m`, `_cm`, `_percent`), and `warning`, the result of `truth_in_doubt`. An undefined score is None."""
    rates = {"TA": score.TA, "TR": score.TR, "FA": score.FA, "FR": score.FR}
    return {
        **{name: {"count": r.count, "of": r.of, "rate": r.rate} for name, r in rates.items()},
        "spurious": score.spurious,
        "completeness": score.completeness,
        "correctness": score.correctness,
        "f1": score.f1,
        "position_rmse_m": score.position_rmse,
        "position_bias_m": score.position_bias,
        "dbh_rmse_cm": None if score.dbh_rmse is None else 100.0 * score.dbh_rmse,
        "dbh_bias_cm": None if score.dbh_bias is None else 100.0 * score.dbh_bias,
        "dbh_count": score.dbh_count,
        "mean_pair_error_percent": score.mean_pair_error_percent,
        "largest_pair_error_percent": score.largest_pair_error_percent,
        "reach_m": score.reach,
        "beyond": score.beyond,
        "warning": truth_in_doubt(score),
    }


def pairs_payload(trees: Trees, truth: TruthTrees | None, match_distance: float) -> dict[str, Any]:
    """Return the distances between the confirmed trees as a dict. The keys are `numbers`, a list of the
    numbers of T trees; `distance_m`, nested lists of shape (T, T); `error_percent`, nested lists of shape (T,
    T) with the error of each distance if both trees are matched with true trees, else NaN (None if there is
    no ground truth); and `left_out`, the number of confirmed trees that are not included.

    Only the first MOST_PAIRED confirmed trees are included.

    Args:
        trees: The map.
        truth: Ground truth, or None.
        match_distance: Maximum distance of a match [m].
    """
    rows = np.flatnonzero(trees.confirmed)
    kept = rows[:MOST_PAIRED]
    position = trees.position[kept]
    payload: dict[str, Any] = {
        "numbers": trees.number[kept].tolist(),
        "distance_m": np.round(pair_distances(position), 3).tolist(),
        "error_percent": None,
        "left_out": len(rows) - len(kept),
    }
    if truth is None:
        return payload
    true_position = np.stack([truth.x, truth.y], axis=1)
    truth_of = match(position, true_position, match_distance)
    matched = np.flatnonzero([row >= 0 and truth.kind[row] == "tree" for row in truth_of])
    errors = np.full((len(kept), len(kept)), np.nan)
    found = pair_errors(position[matched], true_position[truth_of[matched]])
    errors[np.ix_(matched, matched)] = np.round(found.percent, 2)
    return {**payload, "error_percent": errors.tolist()}
