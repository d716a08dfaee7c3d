"""The page on a desk, a tablet and a phone."""

from __future__ import annotations

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import opened
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server

SPILLS = """() => [...document.querySelectorAll('header *, main *, footer *')].filter(node => {
  const box = node.getBoundingClientRect();
  if (!box.width || getComputedStyle(node).visibility === 'hidden') return false;
  if (node.closest('.scroll, svg, .figures, .tabs')) return false; // scrolls or is cut by itself
  return box.right > innerWidth + 1 || box.left < -1;
}).map(node => `${node.tagName}#${node.id}.${node.className}`)"""

# The strip of figures cuts what does not fit: nothing may need to be cut.
CUT = """() => {
  const { right: edge } = document.querySelector('.figures').getBoundingClientRect();
  const shown = [...document.querySelectorAll('.figures > div')].filter(node => node.offsetWidth > 0);
  return shown.filter(node => node.getBoundingClientRect().right > edge + 1).map(node => node.dataset.figure);
}"""

# What is wider than the drawer.
WIDER = """() => [...document.querySelectorAll('#side *')].filter(node =>
  node.offsetWidth > 0 && !node.closest('.scroll')
  && node.getBoundingClientRect().right > document.querySelector('#side').getBoundingClientRect().right + 1
).map(node => `${node.tagName}#${node.id}`)"""

# A live run with the longest figures that are usual, or as it begins.
LIVE = """async busy => {
  const { state, changed } = await import('/static/js/core/store.js');
  const figures = busy ? { recording: 'recording run.mcap, 1234.5 MB', health: 'lost', trees: 1234,
    scan_rate_hz: 10, scans_behind: 123, scans_left_out: 1357, scans_lost: 123, silence_s: 0.2,
    mapping_ms: 141.2, distance_m: 12345.6 }
    : { recording: '', health: 'good', trees: 0, scan_rate_hz: 0, scans_behind: 0, scans_left_out: 0,
    scans_lost: 0, silence_s: null, mapping_ms: 0, distance_m: 0 };
  state.status = { ...state.status, state: busy ? 'playing' : 'waiting', live: true, robot: 'forwarder-07',
    robots: [], source: 'zenoh:tcp/192.168.100.200:7447', ...figures };
  state.statusAt = performance.now();
  state.evaluation = state.truth = null;
  changed('status');
}"""

# Nothing that the server sends may come in between.
SEEN = "async busy => {{ await ({})(busy); return [({})(), ({})(), ({})(), ({})(), ({})()]; }}"
WORDS = """() => [...['dd', 'dt'].map(part => document.querySelector(`[data-figure=data] ${part}`).innerText),
  document.querySelector('#state').title]"""

NAME = """() => {
  const parts = [...document.querySelectorAll('#source-name, #source-name *')];
  const isCut = part => part.scrollWidth > part.clientWidth + 1 && part.clientWidth > 0;
  return [parts[0].textContent, parts.some(isCut)];
}"""

# Places of the figures in the strip with its height, those that are shown whole, and those whose text is cut.
STRIP = """() => {
  const list = document.querySelector('.figures'), edge = list.getBoundingClientRect();
  const cells = [...list.children].filter(node => node.offsetWidth > 0);
  const shown = cells.filter(node => node.getBoundingClientRect().top < edge.bottom - 1);
  const places = shown.map(node => [node.dataset.figure, node.getBoundingClientRect().left]);
  const isCut = node => [node, ...node.querySelectorAll('dd, dt')].some(part =>
    part.scrollWidth > part.clientWidth + 1 || part.scrollHeight > part.clientHeight + 1);
  return [[document.querySelector('.strip').getBoundingClientRect().height, ...places],
    shown.filter(isCut).map(node => node.dataset.figure)];
}"""


# What stands side by side in the strip may not lie upon one another.
OVERLAPS = """() => {
  const parts = [...document.querySelectorAll('.strip > *, .strip-end > *, #state b, #recording')];
  const shown = parts.filter(node => node.offsetWidth > 0 && !node.matches('.strip-end, .run-state'));
  const box = node => node.getBoundingClientRect();
  const meet = (a, b) => a.left < b.right - 1 && b.left < a.right - 1
    && a.top < b.bottom - 1 && b.top < a.bottom - 1;
  return shown.flatMap((a, k) => shown.slice(k + 1).filter(b => meet(box(a), box(b)))
    .map(b => `${a.id || a.tagName} and ${b.id || b.tagName}`));
}"""


# Windows in which a page is opened, each with the sizes to which it is changed. The two that are not of a
# device are 1600 x 900 and 1280 x 720 at a zoom of 200 %.
SIZES = {
    (1440, 900): [(1280, 800), (1024, 768), (800, 450)],
    (390, 844): [(640, 360), (820, 1180)],
}


@pytest.mark.parametrize("size", SIZES)
def test_nothing_overflows_the_page(chromium: Browser, server: Server, size: tuple[int, int]):
    with opened(chromium, server.link, *size, scene=size[0] == 390) as dashboard:
        dashboard.until("() => document.querySelectorAll('#trees tbody tr').length > 0")
        check(dashboard, size)
        if size[0] == 390:
            check_scene_on_demand(dashboard)
        for other in SIZES[size]:
            dashboard.page.set_viewport_size({"width": other[0], "height": other[1]})
            dashboard.drawn()
            check(dashboard, other)
            if other[0] == 1280:
                check_map_stays(dashboard)
            if other[0] == 1024:
                check_drawer(dashboard)


def test_the_strip_of_a_live_run_is_whole_and_nothing_in_it_moves(mapped: Dashboard):
    page = mapped.page
    for width, height in ((1440, 900), (1280, 720), (1024, 768), (820, 1180), (390, 844), (360, 740)):
        page.set_viewport_size({"width": width, "height": height})
        mapped.drawn()
        places, words = [], []
        for busy in (False, True):
            seen = page.evaluate(SEEN.format(LIVE, STRIP, SPILLS, OVERLAPS, WORDS, NAME), busy)
            (place, cut), spills, overlaps, words, name = seen
            assert cut == [], width
            assert spills == [], width
            assert overlaps == [], width
            places.append(place)
            assert name == ["192.168.100.200:7447", False], width
        assert places[0] == places[1], width
        if width == 1440:
            shown = {name for name, _ in places[1][1:]}
            assert shown == {"trees", "health", "data", "driven", "behind", "mapping", "rate", "sigma"}
            assert words == ["0.2s old", "link: 123 lost\nmapping: 1234 left out", "Live forwarder-07"]
        assert "data" in {name for name, _ in places[1][1:]}, width
        if width < 400:
            assert places[1][0] < 0.15 * height


def check(dashboard: Dashboard, size: tuple[int, int]) -> None:
    assert dashboard.page.evaluate(SPILLS) == [], size
    assert dashboard.page.evaluate("document.documentElement.scrollWidth") <= size[0]
    assert dashboard.page.evaluate(OVERLAPS) == [], size
    assert dashboard.page.evaluate(CUT) == [], size
    for name in ("runs-link", "palette-button", "share-button", "theme-button", "keys-button"):
        expect(dashboard.page.locator(f"#{name}")).to_be_in_viewport(ratio=1)


def check_map_stays(dashboard: Dashboard) -> None:
    frame = dashboard.page.locator(".map-frame")
    for size in ((1280, 757), (1920, 1080), (1280, 800)):
        dashboard.page.set_viewport_size({"width": size[0], "height": size[1]})
        heights = set()
        for tab in dashboard.tabs():
            if tab == "Tune":  # whose sliders take the room
                continue
            dashboard.tab(tab)
            heights.add(frame.evaluate("node => node.getBoundingClientRect().height"))
        assert len(heights) == 1, f"at {size} the map jumps with the tab: {heights}"
    dashboard.page.set_viewport_size({"width": 1280, "height": 720})
    dashboard.tab("Tune")
    expect(dashboard.page.locator("#tune-rows input[type=range]").first).to_be_in_viewport(ratio=1)
    dashboard.page.set_viewport_size({"width": 1280, "height": 800})


def check_drawer(dashboard: Dashboard) -> None:
    side = dashboard.page.locator("#side")
    expect(side).to_be_visible()  # a tablet begins with the map
    assert dashboard.page.evaluate(SPILLS) == []
    assert dashboard.page.evaluate(WIDER) == []
    dashboard.page.locator("#drawer-button").click()
    expect(side).not_to_be_visible()


def check_scene_on_demand(dashboard: Dashboard) -> None:
    assert dashboard.page.locator("#scene").get_attribute("src") is None
    dashboard.page.get_by_role("button", name="Show the 3D scene").click()
    dashboard.scene.wait_for_function("() => window.__viserSceneTree?.getState()['/world/robot/scan/raw']")
    expect(dashboard.scene.get_by_text("Reset all")).not_to_be_visible()  # the panel would cover the scene
