"""The numbers of the trees on the page are those of trees.csv."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from app.dashboard.payload import trees_payload
from pipeline.io.result_files import TREE_COLUMNS, tree_rows
from tests.app.fakes import trees

SAME = {"x": "x_m", "y": "y_m", "dbh_cm": "dbh_cm", "sigma_dbh_cm": "sigma_dbh_cm", "height_m": "height_m"}


def test_numbers_are_rounded_once_and_to_the_decimals_of_the_file() -> None:
    # 28.1503 cm is 28.2 cm, but 28.15 in two decimals is 28.1 after another rounding.
    rng = np.random.default_rng(3)
    many = trees(200)
    n = len(many.number)
    many = replace(
        many,
        position=rng.uniform(-50.0, 50.0, (n, 2)),
        dbh=np.append(0.281503, rng.uniform(0.05, 0.6, n - 1)),
        dbh_sigma=rng.uniform(0.001, 0.03, n),
        height=rng.uniform(5.0, 30.0, n),
        height_sigma=np.full(n, 0.1),
        confirmed=np.ones(n, np.bool_),
    )
    written = [dict(zip(TREE_COLUMNS, row, strict=True)) for row in tree_rows(many, 0)]
    shown = trees_payload(many, 0)
    assert shown[0]["dbh_cm"] == 28.2
    for key, column in SAME.items():
        assert [tree[key] for tree in shown] == [float(row[column]) for row in written], key
