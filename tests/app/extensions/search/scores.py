"""Scores without a dependency, so that processes of tests start fast."""

from __future__ import annotations

from typing import Any


def scores(f1: float | None, *, found: int = 3, wrong: int = 0) -> dict[str, Any]:
    """Return scores as a worker sends them; they differ only in their F1."""
    rate = {"of": 4}
    return {
        "TA": {"count": found, **rate}, "FR": {"count": 4 - found, **rate},
        "TR": {"count": 4 - wrong, **rate}, "FA": {"count": wrong, **rate},
        "spurious": 0, "completeness": 0.75, "correctness": 1.0, "f1": f1, "position_rmse": 0.1,
        "position_bias": 0.05, "dbh_rmse": None, "dbh_bias": None, "dbh_count": 0,
        "mean_pair_error_percent": 0.5, "largest_pair_error_percent": 1.0, "reach": 10.0,
    }  # fmt: skip
