"""True trees of labelled scans as CSV files: `python -m tests.benchmarks.park_truth --out DIR SCENE...`.

A scene is a folder of scans from one place with a label a point; its trees are the middles of the labelled
trunks of at least 30 returns within 25 m of the sensor, as in `tests.benchmarks.trunks`. Poles are included.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
from sklearn.cluster import DBSCAN

from pipeline.types.records import Float
from tests.benchmarks.package_forest.labelled_scenes import LEAST_RETURNS, labelled_points, trunks

REACH = 25.0  # m
POLE = 80


def main() -> None:
    """Write a file for each scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for scene in arguments.scenes:
        points, label = labelled_points(scene)
        rows = [("tree", *place) for place in trunks(points, label, LEAST_RETURNS, REACH)]
        rows += [("pole", *place) for place in _poles(points[label == POLE])]
        with (arguments.out / f"{scene.name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(("x_m", "y_m", "class"))
            writer.writerows((f"{x:.3f}", f"{y:.3f}", kind) for kind, x, y in rows)
        print(f"{scene.name}: {len(rows)} trees and poles")


def _poles(points: Float) -> list[Float]:
    if len(points) == 0:
        return []
    group = DBSCAN(eps=0.3, min_samples=1).fit(points).labels_
    middles = [points[group == k, :2].mean(axis=0) for k in range(group.max() + 1)]
    return [place for place in middles if np.hypot(*place) <= REACH]


if __name__ == "__main__":
    main()
