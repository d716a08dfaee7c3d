"""An obstacle in the way of the robot is reported below the strip."""

from __future__ import annotations

from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard

# Buttons of the page that the line about the obstacle, or another part of the page, covers.
COVERED = """part => {
  const way = document.querySelector(part).getBoundingClientRect();
  const covers = (box) => box.width
    && box.left < way.right && box.right > way.left && box.top < way.bottom && box.bottom > way.top;
  return [...document.querySelectorAll('button')].filter(node => covers(node.getBoundingClientRect()))
    .map(node => node.id || node.textContent);
}"""


def test_a_person_in_the_way_is_reported(dashboard: Dashboard):
    way = dashboard.page.locator("#way")
    dashboard.open("sim:crossing?duration=12")  # a person crosses the way at 9 s
    for time_s, zone, text in ((10.6, "stop", "Stop: obstacle"), (6.5, "clear", "")):
        dashboard.go_to(time_s)
        dashboard.until("zone => document.getElementById('way').dataset.zone === zone", zone)
        if text:
            expect(way).to_contain_text(text)
            box = way.bounding_box()
            assert box is not None
            assert box["height"] > 20
            for width, height in ((1440, 900), (1280, 720), (820, 1180), (390, 844), (1260, 720)):
                dashboard.page.set_viewport_size({"width": width, "height": height})
                dashboard.drawn()
                assert dashboard.page.evaluate(COVERED, "#way") == [], f"{width} px"
        else:
            expect(way).to_be_hidden()


# Whether the ring around the nearest obstacle is painted on the 2D map in the colour of its zone while the
# run is in a state; in its own state if that is "".
RING = """async (word) => {
  const { state, changed } = await import('/static/js/core/store.js');
  const { colour } = await import('/static/js/core/theme.js');
  const { screenOf } = await import('/static/js/map/map.js');
  const frame = () => new Promise(requestAnimationFrame);
  const real = state.status;
  if (word) {
    state.status = { ...real, state: word };
    changed('status');
  }
  await frame();
  await frame();
  const { zone } = state.map.clearance, canvas = document.getElementById('map');
  const { x, y } = state.map.obstacle;
  const [px, py] = screenOf(x, y), radius = Math.max(12, screenOf(x + 0.3, y)[0] - px);
  const pen = canvas.getContext('2d'), wanted = colour(zone === 'stop' ? 'pole' : 'warn').toLowerCase();
  const isPainted = ([px, py]) => {
    const { data } = pen.getImageData(px * devicePixelRatio, py * devicePixelRatio, 1, 1);
    return wanted === '#' + [...data.slice(0, 3)].map((each) => each.toString(16).padStart(2, '0')).join('');
  };
  const isSeen = [[px, py - radius], [px - radius, py], [px, py + radius]].some(isPainted);
  state.status = real;
  changed('status');
  return isSeen;
}"""
# Whether the ring in the legend has the colour of a zone.
LEGEND = """async (zone) => {
  const [{ state, changed }, { colour }] = await Promise.all(
    [import('/static/js/core/store.js'), import('/static/js/core/theme.js')]);
  state.map.clearance = { ...state.map.clearance, zone };
  changed('status');
  await new Promise((resolve) => setTimeout(resolve, 1100)); // longer than two updates of the legend
  const box = document.createElement('i');
  box.style.color = colour(zone === 'stop' ? 'pole' : 'warn');
  const ring = getComputedStyle(document.getElementById('legend-obstacle'), '::before');
  return ring.borderTopColor === box.style.color;
}"""
NAMED = "() => document.getElementById('legend-obstacle').checkVisibility()"
THEME = "async (name) => (await import('/static/js/core/theme.js')).setTheme(name)"


def test_the_map_marks_the_obstacle_while_it_is_reported(dashboard: Dashboard):
    page = dashboard.page
    dashboard.open("sim:crossing?duration=12")
    dashboard.go_to(10.6)
    expect(page.locator("#way")).to_contain_text("Stop: obstacle")
    dashboard.until(NAMED)
    for width, theme in ((390, "dark"), (390, "light"), (1440, "light"), (1440, "dark")):
        page.set_viewport_size({"width": width, "height": 844})
        page.evaluate(THEME, theme)
        dashboard.drawn()
        assert page.evaluate(RING, ""), (width, theme)
    for zone in ("slow", "stop"):
        assert page.evaluate(LEGEND, zone), zone
    assert not page.evaluate(RING, "finished"), "the data are old"
    assert page.evaluate(RING, "")
    dashboard.go_to(6.5)
    dashboard.until("() => !document.getElementById('legend-obstacle').checkVisibility()")


# Whether the line about the obstacle is seen: nothing lies on it.
ON_TOP = """() => {
  const way = document.getElementById('way'), box = way.getBoundingClientRect();
  way.style.pointerEvents = 'auto';
  const top = box.width > 0 && document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
  way.style.pointerEvents = '';
  return Boolean(top) && way.contains(top) && box.top >= 0;
}"""


def test_no_dialog_covers_the_stop_of_an_obstacle(dashboard: Dashboard):
    page = dashboard.page
    dashboard.open("sim:crossing?duration=12")
    dashboard.go_to(10.6)
    expect(page.locator("#way")).to_contain_text("Stop: obstacle")
    for width, height in ((1280, 720), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        for button, dialog in (("source-button", "source-dialog"), ("share-button", "share-dialog"),
                               ("keys-button", "keys-dialog"), ("palette-button", "palette")):  # fmt: skip
            page.locator(f"#{button}").click()
            expect(page.locator(f"#{dialog}")).to_be_visible()
            dashboard.until(ON_TOP)
            page.keyboard.press("Escape")
            expect(page.locator(f"#{dialog}")).to_be_hidden()
            dashboard.until(ON_TOP)


# A live run that waits for its robot, with a long reason.
SILENT_RUN = """async (for_s) => {
  const { state, changed } = await import('/static/js/core/store.js');
  const detail = `Nothing heard for ${for_s} s: robot forwarder-07 is gone; the map goes on when it is back`;
  state.status = { ...state.status, live: true, state: 'waiting', detail, health: `no data for ${for_s} s`,
    silence_s: for_s };
  state.statusAt = performance.now();
  changed('status');
}"""
SILENT = f"""async (for_s) => {{
  await ({SILENT_RUN})(for_s);
  const way = document.querySelector('#way');
  return [way.hidden ? '' : way.innerText, way.dataset.zone, document.querySelector('#notice').hidden,
    ...['.map-frame canvas', '#scene'].map(part => getComputedStyle(document.querySelector(part)).filter)];
}}"""
# No status of the server replaces the one that a test shows.
STAYS = """async () => (await import('/static/js/core/live_feed.js')).receive('status', () => {})"""
# One that has ended.
ENDED_RUN = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  state.status = { ...state.status, state: 'finished' };
  changed('status');
}"""
# One whose robot does not know where it is; `zone` is that of an obstacle.
LOST = """async (zone) => {
  const { state, changed } = await import('/static/js/core/store.js');
  const health = { ...state.map.health, state: 'lost', reason: 'the known trees are not found' };
  const clearance = zone && { ...state.map.clearance, zone, ahead_m: 0.8 };
  state.status = { ...state.status, live: true, state: 'playing', health: 'lost', detail: '' };
  state.map = { ...state.map, health, clearance };
  state.statusAt = state.heardAt = performance.now();
  changed('map');
  changed('status');
  const way = document.querySelector('#way');
  const { isPoseLost } = await import('/static/js/shell/way.js');
  return [way.hidden ? '' : way.innerText, way.dataset.zone, isPoseLost()];
}"""
# The next map is of a scan at which the pose is known again, before the status says so.
NEXT_MAP = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  state.map = { ...state.map, health: { ...state.map.health, state: 'good', reason: '' } };
  changed('map');
  return document.querySelector('#way').innerText;
}"""
# One that waits for its first scan.
UNHEARD = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  const detail = 'Waiting: no connection to tcp/127.0.0.1:7447: no Zenoh router answers there. Is it '
    + 'running, is the address right, and is the network up? It is tried again every second';
  state.status = { ...state.status, live: true, state: 'waiting', detail, scan_index: -1,
    source: 'zenoh:tcp/192.168.1.7:7448?robot=red' };
  changed('status');
  return document.querySelector('#notice').hidden;
}"""


# The button of that message, pressed before the next status of the server replaces the message.
CHANGE_ADDRESS = f"""async () => {{
  await ({UNHEARD})();
  const button = document.querySelector('#notice-open');
  if (button.checkVisibility()) button.click();
  return button.innerText;
}}"""


REAL_STATUS = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  state.status = await (await fetch('/api/status')).json();
  changed('status');
}"""


def test_a_notice_covers_no_button(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(6.05)
    page.evaluate(STAYS)
    for name in ("Trees", "Tune"):
        dashboard.tab(name)
        for width, height in ((1440, 900), (1280, 720), (390, 844), (1260, 720)):
            page.set_viewport_size({"width": width, "height": height})
            dashboard.drawn()
            assert not page.evaluate(UNHEARD)
            assert page.evaluate(COVERED, "#notice") in ([], ["notice-open"]), f"{name}, {width} px"
            page.evaluate(REAL_STATUS)
            page.evaluate(SILENT, 12)
            assert page.evaluate(COVERED, "#way") == ["way-sound"], f"{name}, {width} px"
    page.reload()


def test_a_silence_is_as_loud_as_a_stop_and_the_picture_looks_stale(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(6.05)
    page.evaluate(STAYS)
    why = "Robot forwarder-07 is gone; the map goes on when it is back"
    for for_s, zone in ((2, "slow"), (12, "silent")):
        text, shown, has_no_notice, *filters = page.evaluate(SILENT, for_s)
        sound = ["Sound is off …"] if zone == "silent" else []
        assert (text.splitlines(), shown) == ([f"■ No data for {for_s} s", why, *sound], zone)
        assert has_no_notice, "one alarm, not two"
        assert filters == ["grayscale(1)"] * 2
    health = page.locator("[data-figure=health]")
    expect(health.locator("dd span")).to_have_text("no data")
    expect(health.locator("dt")).to_have_text("for 12 s")
    expect(health).to_have_class("warn")  # and not the quality of the last pose
    page.evaluate(REAL_STATUS)
    expect(page.locator("#way")).to_be_hidden()
    dashboard.until("() => getComputedStyle(document.querySelector('#scene')).filter === 'none'")
    page.reload()


# The server was started again with another link while a robot drives.
REFUSED = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  state.status = { ...state.status, live: true, state: 'playing' };
  Object.assign(state, { connected: false, refused: true, lostAt: performance.now() - 9500 });
  changed('connection');
  const way = document.querySelector('#way');
  return [way.dataset.zone, way.innerText, document.querySelector('#notice').hidden, document.body.className];
}"""


def test_an_alarm_stays_on_a_page_that_the_server_does_not_accept_any_more(dashboard: Dashboard):
    dashboard.stand(6.05)
    zone, text, has_no_notice, classes = dashboard.page.evaluate(REFUSED)
    assert (zone, has_no_notice) == ("silent", True)
    assert text.startswith("■ No access for 9 s")
    assert "Open the link that stemmap printed" in text
    assert "stale" in classes.split()
    dashboard.page.reload()


# The last status, as of a live run that has mapped something; later ones do not come in between.
LIVE_STATUS = """async (word) => {
  const { state, changed } = await import('/static/js/core/store.js');
  state.status = { ...state.status, live: true, state: word, robot: 'red' };
  changed('status');
  return ['play', 'back1', 'on10', 'end-run'].map((id) => document.getElementById(id))
    .map((node) => (node.hidden ? 'hidden' : node.disabled ? 'disabled' : 'there'));
}"""
END_TWICE = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  state.status = { ...state.status, live: true, state: 'playing' };
  changed('status');
  const button = document.getElementById('end-run');
  button.click();
  const asked = button.textContent;
  button.click();
  return [asked, button.textContent];
}"""


def test_a_live_run_is_ended_on_the_page_by_two_presses(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(6.05)
    expect(page.locator("#end-run")).to_be_hidden()
    assert page.evaluate(LIVE_STATUS, "playing") == ["there", "hidden", "hidden", "there"]
    assert page.evaluate(LIVE_STATUS, "finished") == ["disabled", "hidden", "hidden", "hidden"]
    page.route("**/api/command", lambda route: route.fulfill(status=202, json={}))
    with page.expect_request("**/api/command") as request:
        assert page.evaluate(END_TWICE) == ["End it now?", "End run"]
    assert request.value.post_data_json == {"type": "end_run"}
    page.unroute("**/api/command")
    page.evaluate(REAL_STATUS)
    expect(page.locator("#end-run")).to_be_hidden()
    expect(page.locator("#back1")).to_be_visible()


# A live run whose recording has a state; what its button reads before and after a press.
RECORDING = """async (recording) => {
  const { state, changed } = await import('/static/js/core/store.js');
  const file = recording && '/data/run.mcap';
  state.status = { ...state.status, live: true, state: 'playing', recording, recorded_file: file };
  changed('status');
  const button = document.getElementById('recording'), before = button.textContent;
  button.click();
  return [before, button.textContent, button.title];
}"""


def test_a_recording_begins_with_one_press_and_ends_with_two(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(6.05)
    page.route("**/api/command", lambda route: route.fulfill(status=202, json={}))
    for recording, text in (("", "○ Record"), ("recorded run.mcap, 3 MB", "○ Record again"),
                            ("not recording: no space", "⚠ not recording")):  # fmt: skip
        with page.expect_request("**/api/command") as request:
            assert page.evaluate(RECORDING, recording)[0] == text
        assert request.value.post_data_json == {"type": "record"}
    before, asked, title = page.evaluate(RECORDING, "recording run.mcap, 3 MB")
    assert (before, asked) == ("● recording 3 MB", "End recording?")
    assert "/data/run.mcap" in title
    with page.expect_request("**/api/command") as request:
        page.evaluate(RECORDING, "recording run.mcap, 3 MB")
    assert request.value.post_data_json == {"type": "end_recording"}
    expect(page.locator("#problem")).to_contain_text("/data/run.mcap")
    page.unroute("**/api/command")
    page.evaluate(REAL_STATUS)
    expect(page.locator("#recording")).to_be_hidden()


# What is shown when a recording has ended, or the kernels are compiled for the source that is opened.
ENDED = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  for (const recording of ['recording run.mcap, 2 MB', 'recorded run.mcap, 3 MB']) {
    state.status = { ...state.status, live: true, state: 'playing', recording,
      recorded_file: '/data/run.mcap' };
    changed('status');
  }
  return [document.querySelector('#problem').innerText, document.querySelector('#speed').disabled];
}"""
OPENING = """async (source) => {
  const { state, changed } = await import('/static/js/core/store.js');
  state.status = { ...state.status, source, state: 'starting', detail: 'Kernels are compiled',
    kernels_left: 12, compiled: 0.5, compiling_since_s: Date.now() / 1000 - 40 };
  changed('status');
  return [document.querySelector('#source-waits').innerText, document.querySelector('#source-none').hidden];
}"""


def test_the_end_of_a_recording_names_its_file_and_size(dashboard: Dashboard):
    dashboard.stand(6.05)
    text, has_no_speed = dashboard.page.evaluate(ENDED)
    assert "Recorded run.mcap, 3 MB: /data/run.mcap" in text
    assert has_no_speed
    dashboard.page.evaluate(REAL_STATUS)


def test_a_wrong_address_is_changed_from_its_message_and_the_wait_has_a_reason(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(6.05)
    page.route("**/api/open", lambda route: route.fulfill(status=202, json={}))
    assert page.evaluate(CHANGE_ADDRESS) == "Change address"
    expect(page.get_by_label("Address of the router")).to_have_value("192.168.1.7")
    page.get_by_label("Port", exact=True).fill("7449")
    uri = "zenoh:tcp/192.168.1.7:7449?robot=red"
    expect(page.locator("#source-uri")).to_have_value(uri)
    page.locator("#source-open").click()
    expect(page.locator("#source-waits")).to_contain_text(f"Opening {uri}")
    waits, is_hidden = page.evaluate(OPENING, uri)
    assert "Kernels are compiled. 50 % done after 40 s, 12 kernels left, about 40 s." in waits
    assert is_hidden, "that it is not in the list says nothing"
    page.locator("#source-close").click()
    page.unroute("**/api/open")
    page.evaluate(REAL_STATUS)


SIGNALS = """() => {
  window.signals = [];
  window.tones = [];
  navigator.vibrate = (pattern) => { window.signals.push('vibration'); return true; };
  window.AudioContext = class {
    currentTime = 0;
    resume() { window.signals.push('sound'); }
    createOscillator() {
      const frequency = {};
      return { frequency, connect() {}, start() { window.tones.push(frequency.value); }, stop() {} };
    }
  };
}"""


def test_sound_and_vibration_for_the_stop_zone_are_off_until_a_person_wants_them(dashboard: Dashboard):
    page = dashboard.page
    page.evaluate(SIGNALS)
    dashboard.open("sim:crossing?duration=12")
    at_stop = "() => document.getElementById('way').dataset.zone === 'stop'"

    def drive_to_the_person() -> None:
        dashboard.go_to(9.0)
        dashboard.command({"type": "play"})
        dashboard.until(at_stop)

    drive_to_the_person()
    assert page.evaluate("window.signals") == []
    dashboard.pause()  # the signal repeats while the run plays
    for name in ("Sound", "Vibration"):
        page.locator("#keys-button").click()
        page.get_by_label(f"{name} while an obstacle").check()
        page.keyboard.press("Escape")
        assert page.evaluate("window.signals.splice(0)") == [name.lower()], "a person knows how it is"
    drive_to_the_person()
    dashboard.until("() => new Set(window.signals).size === 2")
    dashboard.pause()


def test_a_warning_of_a_live_run_tells_once_that_sound_is_off(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(6.05)
    page.evaluate(STAYS)
    hint, box = page.locator("#way-sound"), page.locator("#alarm-sound")
    expect(hint).to_be_hidden()
    box.evaluate("(box) => { box.checked = false; }")  # another test may have left it on
    for turned_on in (False, True):
        page.evaluate("() => localStorage.removeItem('stemmap.alarm-sound')")
        page.evaluate(SILENT, 12)
        hint.click()
        expect(box).to_be_focused()
        box.set_checked(turned_on)
        page.keyboard.press("Escape")
        page.evaluate(SILENT, 13)
        expect(page.locator("#way")).to_be_visible()
        expect(hint).to_be_hidden()
    box.evaluate("(box) => { box.checked = false; }")
    page.evaluate("() => localStorage.removeItem('stemmap.alarm-sound')")
    page.evaluate(SILENT, 2)
    expect(hint).to_be_hidden()  # not yet as loud as a stop
    page.evaluate(REAL_STATUS)
    page.reload()


# A live run that a person has paused.
PAUSED = """async () => {
  const { state, changed } = await import('/static/js/core/store.js');
  state.status = { ...state.status, live: true, state: 'paused', health: 'good', silence_s: 0,
    map_age_s: 23 };
  state.statusAt = performance.now();
  changed('status');
  const way = document.querySelector('#way');
  const { isSilent } = await import('/static/js/shell/way.js');
  return [way.innerText, way.dataset.zone, isSilent(), document.body.classList.contains('stale')];
}"""


def test_a_paused_live_run_says_that_it_is_not_current_and_makes_no_sound(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(6.05)
    page.evaluate(STAYS)
    text, zone, is_silent, is_stale = page.evaluate(PAUSED)
    assert "Paused: not current for 23 s" in text
    assert (zone, is_silent) == ("slow", False)
    assert not is_stale, "a person annotates meanwhile"
    page.evaluate(REAL_STATUS)
    page.reload()


def test_a_lost_pose_of_a_robot_is_reported_below_a_stop(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(6.05)
    page.evaluate(STAYS)
    text, zone, is_lost = page.evaluate(LOST, None)
    assert "Pose lost" in text
    assert "The known trees are not found" in text
    assert (zone, is_lost) == ("lost", True)
    assert "The known trees are not found" in page.evaluate(NEXT_MAP), "its status comes later"
    text, zone, is_lost = page.evaluate(LOST, "stop")
    assert "Stop: obstacle" in text
    assert (zone, is_lost) == ("stop", False)
    assert "Pose lost" in page.evaluate(LOST, "slow")[0]
    page.evaluate(ENDED_RUN)
    expect(page.locator("#way")).to_be_hidden()
    page.evaluate(REAL_STATUS)
    page.reload()


def test_the_page_of_runs_reports_the_open_robot_as_the_dashboard_does(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(6.05)
    page.evaluate("() => localStorage.setItem('stemmap.alarm-sound', 'on')")
    dashboard_page = page.url
    page.get_by_role("link", name="Runs").click()
    page.evaluate(SIGNALS)
    page.evaluate(STAYS)
    dashboard.until("() => document.querySelector('#way').dataset.zone === 'clear'")  # of the open run
    page.evaluate(PAUSED)
    expect(page.locator("#way")).to_contain_text("Paused: not current for 23 s")
    assert page.evaluate(LOST, "stop")[1:] == ["stop", False]
    assert "Pose lost" in page.evaluate(LOST, None)[0]
    dashboard.until("() => window.tones.includes(330)")
    page.evaluate(SILENT_RUN, 12)
    expect(page.locator("#way")).to_contain_text("No data for 12 s")
    for width in (1440, 820, 390):
        page.set_viewport_size({"width": width, "height": 844})
        dashboard.drawn()
        assert page.evaluate(COVERED, "#way") == [], f"{width} px"
    page.evaluate("() => localStorage.removeItem('stemmap.alarm-sound')")
    page.goto(dashboard_page)


def test_a_silence_of_the_robot_has_a_signal_of_its_own(dashboard: Dashboard):
    page = dashboard.page
    page.evaluate(SIGNALS)
    dashboard.stand(6.05)
    page.locator("#keys-button").click()
    box = page.get_by_label("Sound while")
    box.uncheck()
    box.check()
    page.keyboard.press("Escape")
    (known,) = set(page.evaluate("window.tones.splice(0)"))
    page.evaluate(STAYS)
    page.evaluate(SILENT, 12)
    dashboard.until("() => window.tones.length >= 2")  # it repeats
    (told,) = set(page.evaluate("window.tones.splice(0)"))
    assert told != known, "not the signal of the stop zone"
    is_silent = "async () => (await import('/static/js/shell/way.js')).isSilent()"
    assert page.evaluate(is_silent)
    page.evaluate(ENDED_RUN)
    assert not page.evaluate(is_silent), "the run has ended"
    page.reload()
