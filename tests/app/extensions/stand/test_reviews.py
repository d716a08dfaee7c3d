"""Reviews by a person in stand figures and the report."""

from __future__ import annotations

import json

from tests.app.batch.finished_runs import grid_run, reject_on_page
from tests.app.cli.test_commands import stemmap


def test_commands_use_the_reviews_of_the_page(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path / "kept"))
    folder = grid_run(tmp_path / "run")
    reject_on_page(folder, tmp_path / "kept")
    result = stemmap(capsys, "stand", folder, "--out", tmp_path / "out")
    assert (result.code, result.err) == (0, "review: 1 tree rejected on the page left out\n")
    assert json.loads((tmp_path / "out" / "stand.json").read_text())["trees_left_out"]["rejected"] == 1
    assert "99 trees from 7 cm" in result.out
    stemmap(capsys, "report", folder, "--out", tmp_path / "report.html")
    assert "1 rejected in the review" in (tmp_path / "report.html").read_text()
