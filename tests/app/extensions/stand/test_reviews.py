"""Reviews by a person in stand figures and the report."""

from __future__ import annotations

import json

from app.batch.run_folder import read_run
from app.store.records import Author, Content
from app.store.store import Store
from tests.app.batch.finished_runs import grid_run
from tests.app.cli.test_commands import stemmap


def test_commands_use_the_reviews_of_the_page(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("STEMMAP_FOLDER", str(tmp_path / "kept"))
    folder = grid_run(tmp_path / "run")
    run = read_run(folder)
    x, y = run.trees.position[0].tolist()
    store = Store(tmp_path / "kept")
    number = store.open_run(run.record["source"].get("sha256") or run.uri, run.uri, "grid")
    store.add(number, Author("a" * 16, "Ann"), [Content(x, y, "pole")])
    store.close()
    result = stemmap(capsys, "stand", folder, "--out", tmp_path / "out")
    assert (result.code, result.err) == (0, "review: 1 tree rejected on the page left out\n")
    assert json.loads((tmp_path / "out" / "stand.json").read_text())["trees_left_out"]["rejected"] == 1
    assert "99 trees from 7 cm" in result.out
    stemmap(capsys, "report", folder, "--out", tmp_path / "report.html")
    assert "1 rejected in the review" in (tmp_path / "report.html").read_text()
