"""Training of decision trees from the tab Annotate."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from pipeline.io.readers import open_source
from tests.browser.conftest import opened
from tests.browser.dashboard import COMPILING_S, Dashboard
from tests.browser.serving import Server
from tests.browser.test_annotate import IMPORTED


def test_training_states_what_it_needs_starts_on_request_and_is_stopped(person: Dashboard):
    page = person.page
    learn = page.get_by_role("region", name="Learn")
    grow = learn.get_by_role("button", name="Train decision trees")
    expect(learn).to_contain_text("10 trees and 5 other objects")
    expect(learn).to_contain_text("answer No (N) for a found tree")
    expect(grow).to_be_disabled()
    table = "".join(f"{k},50,{'tree' if k < 10 else 'pole'}\n" for k in range(15))
    page.evaluate(IMPORTED, "x_m,y_m,class\n" + table)
    expect(learn).to_contain_text("Annotated in 1 run: 10 trees, 5 poles.")
    grow.click()
    stop = learn.get_by_role("button", name="Stop")
    expect(stop).to_be_visible()
    expect(learn).to_contain_text("Mapping sim:stand")
    stop.click()
    expect(grow).to_be_enabled()
    person.until_server("/api/learning", "it.state === 'idle' && it.learned === null")
    person.until_server("/api/parameters", "it.values['classification.forest'] === 'package'")
    assert person.errors == []


@pytest.mark.slow
def test_trained_decision_trees_are_compared_with_the_present_ones_and_used_on_request(
    chromium: Browser, tmp_path: Path
):
    uri = "sim:stand?duration=4&trees=40"
    truth = open_source(uri).truth()
    assert truth is not None
    assert truth.trees is not None
    rows_of_truth = zip(truth.trees.x.tolist(), truth.trees.y.tolist(), truth.trees.kind, strict=True)
    table = "".join(f"{x},{y},{kind}\n" for x, y, kind in rows_of_truth)
    with Server(uri, STEMMAP_FOLDER=str(tmp_path)) as server, opened(chromium, server.link) as person:
        person.pause()
        person.until_server("/api/annotations", "it.run !== null")
        person.page.evaluate(IMPORTED, "x_m,y_m,class\n" + table)
        person.tab("Annotate")
        learn = person.page.get_by_role("region", name="Learn")
        learn.get_by_role("button", name="Train decision trees").click()
        use = learn.get_by_role("button", name="Use the new ones")
        expect(use).to_be_visible(timeout=1000 * COMPILING_S)
        expect(learn.get_by_role("row", name=re.compile("^new"))).to_contain_text(" of ")
        person.until_server("/api/parameters", "it.values['classification.forest'] === 'package'")
        use.click()
        expect(learn.locator("#learn-used")).to_contain_text(
            re.compile(r"In use: trained 20\d\d-.* from \d+ trees, .* in 1 run")
        )
        name = person.ask("/api/learning")["learned"]["name"]
        person.until_server("/api/parameters", f"it.values['classification.forest'] === '{name}'")
        learn.get_by_role("button", name="Use the built-in ones").click()
        person.until_server("/api/parameters", "it.values['classification.forest'] === 'package'")
        assert person.errors == []
