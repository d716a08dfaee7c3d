"""The tab Plots of a whole cloud: its coordinates are those of the file, and there is no path."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import opened
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server
from tests.pipeline.plots import ground, stem, write_las

PLACES = ((2.5, 2.5), (7.5, 2.5), (2.5, 7.5), (7.5, 7.5))  # x, y [m]
UTM = (470600.0, 3810200.0, 300.0)


@pytest.fixture(scope="module")
def page(chromium: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Dashboard]:
    rng = np.random.default_rng(2)
    stems = [stem(x, y, 0.14, rng, height=6.0, sigma=0.003) for x, y in PLACES]
    folder: Path = tmp_path_factory.mktemp("stand")
    write_las(folder / "plot.laz", np.concatenate([ground(10.0, 0.05, rng), *stems]), offset=UTM)
    with (
        Server("sim:stand?duration=5", STEMMAP_FOLDER=str(folder / "store")) as server,
        opened(chromium, server.link) as made,
    ):
        made.pause()
        made.open(str(folder / "plot.laz"))
        expect(made.page.locator("#state b")).to_have_text("Mapped")
        expect(made.page.locator("#trees tbody tr")).to_have_count(len(PLACES))
        yield made
        assert made.errors == []


def test_a_typed_plot_has_the_coordinates_of_the_file(page: Dashboard) -> None:
    panel = page.tab("Plots")
    expect(page.page.locator("#plots-hint")).to_contain_text("figures are those of the whole observed area")
    expect(page.page.locator("#plots-detection")).to_contain_text("not estimated for a whole cloud")
    panel.get_by_text("Type a plot, or import a file").click()
    expect(panel.get_by_role("button", name="Add circles")).to_be_hidden()
    form = panel.locator(".plot-form").first
    x, y = form.locator("[name=x]"), form.locator("[name=y]")
    expect(x).to_have_value(f"{UTM[0]:.0f}")
    y.fill(f"{UTM[1] + 5.125:.3f}")
    assert y.evaluate("node => node.scrollWidth <= node.clientWidth")
    rows = panel.locator("#plots-table tr[data-plot]")
    x.fill("5")
    form.get_by_role("button", name="Add").click()
    expect(page.page.locator("#plots-error")).to_have_text(
        re.compile(r"The plot is outside of the cloud.*x 470600 to 470610 m, y 3810200 to 3810210 m")
    )
    expect(rows).to_have_count(0)
    page.errors.clear()  # the refusal
    x.fill(f"{UTM[0] + 5.0:.3f}")
    form.locator("[name=radius]").fill("5")
    form.get_by_role("button", name="Add").click()
    expect(rows).to_have_count(1)
    (plot,) = page.ask("/api/annotations")["others"]["plot"]
    assert plot["shape"] == {"kind": "circle", "x": 5.0, "y": 5.125, "radius": 5.0}
    expect(rows.locator("td").nth(2)).to_have_text(str(len(PLACES)))
    expect(rows.locator("td").nth(3)).to_have_text("509 ± 31")  # in full view: the counting error of 6 %
    page.page.locator("#plot-undo").click()
    expect(rows).to_have_count(0)


def test_the_form_shows_that_the_coordinates_of_the_file_are_in_force(page: Dashboard) -> None:
    panel = page.tab("Plots")
    panel.locator("#coordinates summary").click()
    panel.locator("#coordinates-crs").fill("EPSG:26912")
    panel.locator("#coordinates-how").select_option("file")
    panel.get_by_role("button", name="Apply").click()
    expect(panel.locator("#coordinates-result")).to_contain_text("By the coordinates of the file")
    expect(panel.locator("#coordinates-how")).to_have_value("file")
    expect(panel.locator("#coordinates-hand")).to_be_hidden()
    panel.locator("#coordinates-remove").click()
    expect(panel.locator("#coordinates-remove")).to_be_disabled()
