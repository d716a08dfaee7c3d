"""The dashboard: playback, selection, scores, plots and the dialog that opens a run."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard

pytestmark = pytest.mark.usefixtures("calm")


def test_play_pause_step_and_seek(dashboard: Dashboard):
    page = dashboard.page
    start = dashboard.ask("/api/status")["scan_index"]
    page.get_by_role("button", name="One scan forward").click()
    dashboard.until_server("/api/status", f"it.scan_index === {start + 1}")
    page.get_by_role("button", name="Ten scans back").click()
    dashboard.until_server("/api/status", f"it.scan_index === {start - 9} && it.state === 'paused'")
    page.get_by_role("button", name="Play").click()
    dashboard.until_server("/api/status", f"it.state === 'playing' && it.scan_index > {start}")
    expect(page.locator("#state b")).to_have_text("Playing")
    page.get_by_role("button", name="Pause").click()
    dashboard.until_server("/api/status", "it.state === 'paused'")
    driven = dashboard.ask("/api/status")["distance_m"]
    dashboard.seek(0.05)
    dashboard.until_server("/api/status", f"it.time_s < 0.1 * it.end_s && it.distance_m < {driven}")
    dashboard.until(
        "most => parseFloat(document.querySelector('[data-figure=driven] dd').textContent) < most", driven
    )


def test_the_speed_is_set_on_the_server(dashboard: Dashboard):
    dashboard.page.locator("#speed").select_option("4")
    dashboard.until_server("/api/status", "it.speed === 4")
    dashboard.page.locator("#speed").select_option("1")
    dashboard.until_server("/api/status", "it.speed === 1")


def test_a_tree_is_selected_in_the_map(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Trees")
    page.get_by_role("button", name="Fit").click()
    canvas = page.locator("#map")
    places = page.evaluate(GREEN_PLACES)
    assert places
    canvas.click(position={"x": places[0][0], "y": places[0][1]})
    selected = page.locator("#trees tr[aria-selected=true]")
    expect(selected).to_have_count(1)
    expect(page.locator("#panel-story")).to_be_visible()
    canvas.click(position={"x": 3, "y": 60})
    expect(selected).to_have_count(0)


GREEN_PLACES = """() => {
  const canvas = document.querySelector('#map');
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  const places = [];
  for (let i = 0; i < data.length; i += 4) {
    const [x, y] = [(i / 4) % canvas.width, Math.floor(i / 4 / canvas.width)];
    const green = data[i] === 0 && data[i + 1] === 0x9E && data[i + 2] === 0x73;
    if (green && y > 40) places.push([x / devicePixelRatio, y / devicePixelRatio]);
  }
  return places.slice(0, 1);
}"""


def test_scores_come_with_their_counts(dashboard: Dashboard):
    panel = dashboard.tab("Scores")

    def shown() -> dict[str, str]:
        return {name: panel.locator(f"[data-rate={name}] small").inner_text() for name in RATES}

    def held() -> dict[str, str]:
        score = dashboard.ask("/api/evaluation")
        return {name: f"{score[name]['count']} of {score[name]['of']}" for name in RATES}

    expect(panel.locator("[data-rate=TA] small")).to_contain_text(" of ")
    # The scores of the standing scan come a little after it, here and there at different moments.
    dashboard.eventually(lambda: shown() == held(), lambda: (shown(), held()))


RATES = ("TA", "FR", "TR", "FA")


def test_scores_are_shown_in_centimetres(dashboard: Dashboard):
    panel = dashboard.tab("Scores")
    expect(panel.locator("dl.list")).to_be_visible()

    def shown() -> dict[str, list[str]]:
        texts = {
            name: panel.locator("dt", has_text=name).locator("+ dd").inner_text() for name in CENTIMETRES
        }
        return {name: text.split() for name, text in texts.items()}

    def agrees() -> bool:
        score = dashboard.ask("/api/evaluation")
        return all(
            # Two decimals are shown.
            unit == "cm"
            and float(figure.replace("\N{MINUS SIGN}", "-"))
            == pytest.approx(scale * score[key], rel=0.01, abs=0.006)
            for (figure, unit), (scale, key) in zip(shown().values(), CENTIMETRES.values(), strict=True)
        )

    dashboard.eventually(agrees, lambda: (shown(), dashboard.ask("/api/evaluation")))


CENTIMETRES = {
    "DBH RMSE": (1.0, "dbh_rmse_cm"),
    "DBH bias": (1.0, "dbh_bias_cm"),
    "position RMSE": (100.0, "position_rmse_m"),
    "position bias": (100.0, "position_bias_m"),
}


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("choice", ["distance", "error", "time", "n_eff", "sigma", "quantities"])
@pytest.mark.usefixtures("calm")
def test_the_plots_are_drawn(dashboard: Dashboard, choice: str):
    start = dashboard.ask("/api/status")["scan_index"]
    dashboard.page.locator("#on1").click()  # a curve needs two scans
    dashboard.until_server("/api/status", f"it.scan_index === {start} + 1")
    dashboard.tab("Charts")
    dashboard.page.locator("#chart-choice").select_option(choice)
    expect(dashboard.page.locator("#chart .main-svg").first).to_be_visible()
    drawn = dashboard.page.locator("#chart .hm, #chart .scatterlayer .trace")
    expect(drawn.first).to_be_attached()


@pytest.mark.slow
def test_a_source_that_cannot_be_opened_leaves_the_run_and_says_why(dashboard: Dashboard, tmp_path: Path):
    page = dashboard.page
    dashboard.tab("Trees")
    expect(page.locator("#trees tbody tr").first).to_be_visible()

    def shown() -> tuple[int, dict[str, object]]:
        status = dashboard.ask("/api/status")
        timings = ("mapping_ms", "stage_ms")  # medians, which scans that are mapped ahead change
        return page.locator("#trees tbody tr").count(), {k: v for k, v in status.items() if k not in timings}

    before = shown()
    (tmp_path / "notes.txt").write_text("birch, birch, oak")
    page.locator("#source-button").click()
    for uri, reason in (("/nowhere/run.mcap", "no such file"), (str(tmp_path / "notes.txt"), "Not a LiDAR")):
        page.locator("#source-uri").fill(uri)
        page.get_by_role("button", name="Open", exact=True).click()
        expect(page.locator("#source-error")).to_contain_text(uri)
        expect(page.locator("#source-error")).to_contain_text(reason, ignore_case=True)
    assert shown() == before
    expect(page.locator("#state b")).to_have_text("Paused")
    dashboard.errors.clear()  # the browser logs an answer that refuses
    page.locator("#source-uri").fill("sim:")  # the list has what is typed, also what is folded
    page.get_by_role("button", name="sim:paper").first.click()
    expect(page.locator("#source-dialog")).not_to_be_visible()
    expect(page.locator("#source-name")).to_have_text("sim:paper")
    page.locator("#source-button").click()
    page.locator("#source-uri").fill("sim:")
    page.get_by_role("button", name="sim:stand").first.click()
    expect(page.locator("#source-name")).to_have_text("sim:stand")
    expect(page.locator("#source-dialog")).not_to_be_visible()


# Draws numbers of trees that stand close together with a pen that remembers where; [boxes, what is named].
NUMBERS = """() => import('/static/js/map/draw.js').then(({ drawNumbers }) => {
  const boxes = [], radius = 6;
  const pen = { measureText: (text) => ({ width: 7 * text.length }), strokeText: () => {},
    fillText: (text, x, y) => boxes.push({ text, x, y: y - 9, width: 7 * text.length, height: 11 }) };
  const view = { width: 400, height: 300, toScreen: (x, y) => [x, y] };
  const trees = Array.from({ length: 60 }, (_, k) =>
    ({ number: k + 1, x: 40 + (37 * k) % 300, y: 40 + (53 * k) % 190, observations: k }));
  trees.push({ number: 99, x: 41, y: 41, observations: 0 });
  drawNumbers(pen, view, trees, 99, { radiusOf: () => radius });
  const apart = (a, b) => a.x >= b.x + b.width || a.y >= b.y + b.height;
  const meet = (a, b) => !apart(a, b) && !apart(b, a);
  const size = { width: 2 * radius, height: 2 * radius };
  const symbols = trees.map(({ x, y }) => ({ x: x - radius, y: y - radius, ...size }));
  const others = boxes.filter(({ text }) => text !== '99');
  const covered = others.filter((box) => [...boxes, ...symbols].some((b) => b !== box && meet(b, box)));
  return [boxes.map(({ text }) => text), covered.map(({ text }) => text)];
})"""


@pytest.mark.slow
def test_numbers_on_the_map_overlap_neither_each_other_nor_a_symbol(dashboard: Dashboard):
    named, covered = dashboard.page.evaluate(NUMBERS)
    assert covered == []
    assert named[0] == "99"  # what is selected comes first, and is named in any case
    assert named[1] == "60"  # then what was seen most often
    assert 10 < len(named) <= 61
