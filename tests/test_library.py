"""The programs in docs/library.md run as they stand there."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest

from pipeline.io.readers import open_source
from pipeline.types.records import Scan

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = re.findall(
    r"```python\n(.*?)```", (ROOT / "docs" / "library.md").read_text(encoding="utf-8"), re.DOTALL
)


def names_of(program: str) -> dict[str, Any]:
    """What a program of the document leaves behind."""
    names: dict[str, Any] = {}
    exec(program, names)  # noqa: S102 - our own document
    return names


def test_a_folder_of_scans_is_mapped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "scans"
    folder.mkdir()
    scans = (record for record in open_source("sim:stand").records() if isinstance(record, Scan))
    for number, scan in enumerate(itertools.islice(scans, 25)):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scan.points[:, :3].astype(float)))
        open3d.io.write_point_cloud(folder / f"{number:04}.pcd", cloud)
    result = names_of(PROGRAMS[0])
    head, *trees = result["table"].splitlines()
    assert head.startswith("tree,x_m,y_m")
    assert len(trees) > 5
    assert np.isfinite(result["frame"].estimate.T_map_base.as_array()).all()


def test_a_stage_is_used_alone():
    labels = names_of(PROGRAMS[1])["labels"]
    assert labels.clusters == 2
