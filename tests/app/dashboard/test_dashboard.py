"""What becomes of the worker's messages: scene, browsers, parameters, score."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any
from unittest.mock import AsyncMock

import msgspec
import numpy as np
import pytest
import pytest_asyncio

from app.dashboard.broadcast import Broadcast
from app.dashboard.dashboard import Dashboard
from app.dashboard.parameters import ParameterState
from app.sources.request import SourceRequest
from app.store.records import Author, Content
from app.worker.protocol import (
    Answer,
    AskCluster,
    Begin,
    Open,
    Play,
    Report,
    Seek,
    SetParameters,
    Shown,
    Status,
    Unmapped,
    WorkerBusyError,
)
from pipeline.config import preset
from pipeline.errors import ParameterError, SourceError
from pipeline.ground.terrain_map import no_height_map
from tests.app.explain.stories import cluster_story
from tests.app.fake_scene import FakeScene
from tests.app.fakes import FakeWorker, frame, opened, path, truth_trees


@pytest_asyncio.fixture
async def dashboard() -> AsyncIterator[Dashboard]:
    made = Dashboard(ParameterState(), Broadcast())
    made.worker = FakeWorker()
    made.check_source = AsyncMock()
    await made.start(Open("fake:"), FakeScene)
    yield made
    await made.close()


def worker(dashboard: Dashboard) -> FakeWorker:
    assert isinstance(dashboard.worker, FakeWorker)
    return dashboard.worker


def begun(dashboard: Dashboard) -> Begin:
    """The last word to the worker."""
    last = worker(dashboard).commands[-1]
    assert isinstance(last, Begin)
    return last


def scene_calls(dashboard: Dashboard) -> list[tuple[str, Any]]:
    assert isinstance(dashboard.scene, FakeScene)
    return dashboard.scene.calls


def browser_knows(dashboard: Dashboard) -> dict[str, Any]:
    messages = [json.loads(text) for _, text in dashboard.live.messages_after(0)]
    return {message["type"]: message for message in messages}


async def test_a_source_that_was_left_before_it_was_open_is_not_shown(dashboard: Dashboard) -> None:
    await dashboard.open(Open("fake:second"))
    before = len(worker(dashboard).commands)
    await dashboard.receive(msgspec.structs.replace(opened(run=1), requested="fake:"))
    assert len(worker(dashboard).commands) == before
    await dashboard.receive(msgspec.structs.replace(opened(run=2), requested="fake:second"))
    assert begun(dashboard).run == 2


async def test_an_opened_source_is_played(dashboard: Dashboard) -> None:
    assert isinstance(worker(dashboard).commands[0], SetParameters)
    assert worker(dashboard).commands[1] == Open("fake:")
    await dashboard.receive(opened(truth=truth_trees()))
    assert [begun(dashboard).run, begun(dashboard).play] == [1, True]
    assert ("clear", None) in scene_calls(dashboard)
    assert ("truth", True) in scene_calls(dashboard)
    kinds = [tree["kind"] for tree in browser_knows(dashboard)["truth"]["trees"]]
    assert kinds == ["tree", "tree", "pole"]


async def test_a_run_begins_though_its_repairs_could_not_be_sent(
    dashboard: Dashboard, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def busy() -> None:
        raise WorkerBusyError("the mapping process is busy")

    monkeypatch.setattr(dashboard, "_send_repairs", busy)
    await dashboard.receive(opened())
    assert begun(dashboard).run == 1


async def test_the_preset_that_suits_is_set_before_the_first_scan(dashboard: Dashboard) -> None:
    await dashboard.receive(opened(preset="laser2d"))
    (begin,) = worker(dashboard).commands[2:]
    assert begin == Begin(1, preset("laser2d").model_dump(), 1, play=True)
    assert browser_knows(dashboard)["parameters"]["preset"] == "laser2d"
    assert ("parameters", "laser2d") in scene_calls(dashboard)


async def test_each_run_is_begun_with_its_parameters_even_if_those_of_the_last_one_never_arrived(
    dashboard: Dashboard,
) -> None:
    await dashboard.open(Open("other:"))
    await dashboard.receive(opened(preset="laser2d"))
    await dashboard.receive(opened("other:", preset="laser2d", run=2))
    assert begun(dashboard) == Begin(2, preset("laser2d").model_dump(), 1, play=True)
    await dashboard.receive(opened("other:", run=3))
    assert begun(dashboard) == Begin(3, preset("forest").model_dump(), 2, play=True)


async def test_opening_empties_the_page_at_once_and_nothing_of_the_old_run_comes_back(
    dashboard: Dashboard,
) -> None:
    await dashboard.receive(opened(truth=truth_trees()))
    await dashboard.receive(Shown(1, 0.0, frame(0, 1, n_trees=3), 0, path([0.0])))
    await dashboard.open(Open("missing:"))
    await dashboard.receive(Shown(1, 0.1, frame(1, 2, n_trees=3), 1, path([1.0])))
    await dashboard.receive(Report(Status("failed", "there is no such file")))
    shown = dashboard.live.map_after(0)
    assert shown is not None
    empty = json.loads(shown[1])
    assert (empty["index"], empty["trees"], len(shown[2])) == (-1, [], 0)
    assert scene_calls(dashboard)[-3][0] == "clear"
    assert (dashboard.shown, dashboard.truth, dashboard.path) == (None, None, None)
    assert "trees" not in browser_knows(dashboard)["truth"]


async def test_a_scan_that_is_not_mapped_is_drawn_and_is_no_result(dashboard: Dashboard) -> None:
    await dashboard.receive(opened(truth=truth_trees()))
    await dashboard.receive(Unmapped(1, frame(0, 1)))
    assert scene_calls(dashboard)[-1][0] == "show"
    assert dashboard.shown is None
    await dashboard.receive(Shown(1, 0.0, frame(0, 1, n_trees=3), 0, path([0.0])))
    await dashboard.receive(Unmapped(1, frame(1, 2)))
    await asyncio.sleep(0.2)  # longer than two drawings are apart
    assert ("show", 1) not in scene_calls(dashboard)  # the map stands


async def test_a_source_that_cannot_be_opened_leaves_the_open_run_as_it_is(dashboard: Dashboard) -> None:
    await dashboard.receive(opened(truth=truth_trees()))
    await dashboard.receive(Shown(1, 0.0, frame(0, 1, n_trees=3), 0, path([0.0])))
    told, known = len(worker(dashboard).commands), browser_knows(dashboard)
    dashboard.check_source = AsyncMock(side_effect=SourceError("not a LiDAR recording", where="notes.txt"))
    with pytest.raises(SourceError, match="not a LiDAR"):
        await dashboard.open(SourceRequest("notes.txt", preset="paper"))
    assert dashboard.shown is not None
    assert (dashboard.source.uri, dashboard.parameters.preset) == ("fake:", "forest")
    assert browser_knows(dashboard) == known
    assert len(worker(dashboard).commands) == told


async def test_of_two_sources_that_are_checked_at_once_the_newer_is_opened(dashboard: Dashboard) -> None:
    await dashboard.receive(opened())
    slow = asyncio.Event()

    async def check(request: SourceRequest) -> None:
        if request.uri == "slow:":
            await slow.wait()

    dashboard.check_source = check
    first = asyncio.create_task(dashboard.open(SourceRequest("slow:")))
    await asyncio.sleep(0)
    await dashboard.open(SourceRequest("quick:"))
    slow.set()
    await first
    assert dashboard.source.uri == "quick:"


async def test_a_ground_stands_with_every_picture_after_the_one_that_brought_it(dashboard: Dashboard) -> None:
    """Pictures that come fast are not all drawn, and a scene built anew draws the newest alone."""
    await dashboard.receive(opened())
    ground = no_height_map()
    first, second = frame(0, 5_000_000_000), frame(1, 5_100_000_000)
    await dashboard.receive(Shown(1, 0.0, replace(first, ground=ground), 0, path([0.0])))
    await dashboard.receive(Shown(1, 0.1, replace(second, ground=None), 1, path([0.5])))
    assert dashboard.shown is not None
    assert dashboard.shown.frame.ground is ground
    await dashboard.receive(opened(run=2))
    await dashboard.receive(Shown(2, 0.0, replace(first, ground=None), 0, path([0.0])))
    assert dashboard.shown.frame.ground is None


async def test_what_a_person_chose_stays(dashboard: Dashboard) -> None:
    await dashboard.change_parameters({"clustering.eps": 0.3})
    await dashboard.receive(opened(preset="laser2d"))
    assert browser_knows(dashboard)["parameters"]["preset"] == "forest"
    assert dashboard.parameters.parameters.clustering.eps == 0.3


async def test_flags_are_laid_over_the_preset_that_suits() -> None:
    def begin(suggested: str) -> Any:
        return suggested, preset(suggested).replace({"clustering.eps": 0.33})

    state = ParameterState(begin)
    assert state.suit("laser2d")
    assert (state.preset, state.parameters.clustering.eps) == ("laser2d", 0.33)
    assert state.parameters.clustering.method == "range_jump"
    assert not state.suit("laser2d")


async def test_flags_that_do_not_fit_another_preset_leave_what_is() -> None:
    def begin(suggested: str) -> Any:
        if suggested != "forest":
            raise ParameterError("filters.x_min = 0 must be less than ...")
        return suggested, preset(suggested)

    state = ParameterState(begin)
    state.suit("paper")
    assert state.preset == "forest"


async def test_values_that_were_undone_or_reset_do_not_stick_to_the_next_source() -> None:
    for back in (ParameterState.undo, lambda state: state.reset([])):
        state = ParameterState()
        state.suit("laser2d")
        state.change({"clustering.eps": 0.3})
        back(state)
        state.suit("forest")
        assert (state.preset, state.parameters) == ("forest", preset("forest"))
        assert state.as_plain()["unsuited"] == ""


async def test_a_preset_for_another_kind_of_sensor_is_said_until_it_is_replaced() -> None:
    state = ParameterState()
    state.suit("laser2d")
    state.change({"clustering.eps": 0.3})
    assert state.as_plain()["unsuited"] == ""
    state.suit("forest")
    assert (state.preset, state.as_plain()["unsuited"]) == ("laser2d", "forest")
    state.use_preset("paper")  # also for scans of a 3D LiDAR
    assert state.as_plain()["unsuited"] == ""
    state.suit("stems")
    assert (state.preset, state.as_plain()["unsuited"]) == ("paper", "stems")
    state.use_preset("stems")
    assert state.as_plain()["unsuited"] == ""


async def test_a_picture_goes_to_scene_and_browsers_with_its_whole_path(dashboard: Dashboard) -> None:
    await dashboard.receive(opened())
    await dashboard.receive(Shown(1, 0.0, frame(0, 1), 0, path([0.0])))
    await dashboard.receive(Shown(1, 0.1, frame(1, 2, n_trees=3), 1, path([1.0])))
    async with asyncio.timeout(10):
        while scene_calls(dashboard)[-1] != ("show", 1):
            await asyncio.sleep(0)
    shown = dashboard.live.map_after(0)
    assert shown is not None
    _, encoded, path_xy = shown
    payload = json.loads(encoded)
    np.testing.assert_array_equal(path_xy[:, :2], [[0.0, 0.0], [1.0, 0.0]])
    assert payload["verdicts"] == {"too long": 1}
    assert len(payload["trees"]) == 2


async def test_the_score_follows_the_map_and_goes_with_the_run(dashboard: Dashboard) -> None:
    await dashboard.receive(opened(truth=truth_trees()))
    await dashboard.receive(Shown(1, 0.0, frame(0, 1, n_trees=3), 0, path([0.0])))
    async with asyncio.timeout(20):
        while dashboard.scores.latest is None:
            await asyncio.sleep(0.01)
    score = browser_knows(dashboard)["evaluation"]
    assert score["TA"] == {"count": 2, "of": 2, "rate": 1.0}
    assert score["TR"] == {"count": 1, "of": 1, "rate": 1.0}
    assert score["f1"] == 1.0
    assert score["dbh_rmse_cm"] == pytest.approx(1.0)
    assert score["position_rmse_m"] == pytest.approx(((0.05**2 + 0.1**2) / 2) ** 0.5)
    await dashboard.receive(opened())
    assert browser_knows(dashboard)["evaluation"] == {"type": "evaluation", "value": None}


async def test_a_restarted_worker_stands_at_the_start_and_says_so(dashboard: Dashboard) -> None:
    await dashboard.receive(opened())
    worker(dashboard).restarts = 1
    await dashboard.receive(opened())
    assert not begun(dashboard).play
    await dashboard.receive(Report(Status("paused")))
    assert "started again" in dashboard.status.detail
    await dashboard.command(Play())
    await dashboard.receive(Report(Status("paused")))
    assert dashboard.status.detail == ""


async def test_a_silence_of_a_robot_is_logged_with_the_time_of_its_last_scan(dashboard: Dashboard) -> None:
    await dashboard.receive(opened(run=1))
    await dashboard.receive(Shown(1, 0.0, frame(0, 0), 0, path([0.0])))
    silent = Status("waiting", "Nothing heard for 2 s: the robot is gone", live=True, scan_index=0)
    await dashboard.receive(Report(silent))
    told = browser_knows(dashboard)["events"]
    (last,) = told["events"][-1:]
    assert last.pop("noted_s") == pytest.approx(time.time(), abs=60.0), "by the clock of this computer"
    text = "Nothing heard: the robot is gone"  # the event has its own duration
    assert last == {"t": 0.0, "kind": "silence", "text": text, "for_s": None}
    assert told["start_s"] == pytest.approx(1e-9 * frame(0, 0).stamp_ns)
    paused = replace(silent, state="paused", health="no data for 9 s")
    for status, kinds in (
        (paused, ["silence", "pause"]),
        (replace(paused, health="good"), ["silence", "pause", "silence"]),
        (silent, ["silence", "pause", "silence", "pause", "silence"]),
    ):
        await dashboard.receive(Report(status))
        assert [each["kind"] for each in browser_knows(dashboard)["events"]["events"]] == kinds
    recording = replace(silent, recording="recording a.mcap, 2 MB", recorded_file="/a.mcap")
    await dashboard.receive(Report(recording))
    told = browser_knows(dashboard)["events"]["events"]
    assert [each["text"] for each in told if each["kind"] == "recording"] == ["Recording: /a.mcap"]


async def test_playing_a_dead_worker_plays_once_it_is_back(dashboard: Dashboard) -> None:
    await dashboard.receive(opened())
    worker(dashboard).pid = None
    await dashboard.command(Play())
    worker(dashboard).restarts = 1
    await dashboard.receive(opened())
    assert begun(dashboard).play


async def test_a_selection_is_one_everywhere(dashboard: Dashboard) -> None:
    await dashboard.select_tree(4)
    assert scene_calls(dashboard)[-1] == ("select", 4)
    selection = browser_knows(dashboard)["selection"]
    assert (selection["tree"], selection["cluster"]) == (4, None)
    await dashboard.receive(opened())
    assert browser_knows(dashboard)["selection"]["tree"] is None


async def test_a_cluster_is_selected_with_its_tree_and_stands_while_the_run_goes_on(
    dashboard: Dashboard,
) -> None:
    await dashboard.receive(opened())
    await dashboard.receive(Shown(1, 0.0, frame(231, 0), 0, path([0.0])))
    dashboard.selector.cluster_soon(231, 4)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    (question,) = [m for m in worker(dashboard).commands if isinstance(m, AskCluster)]
    await dashboard.receive(Answer(question.ticket, cluster=cluster_story()))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert scene_calls(dashboard)[-1] == ("select", (12, (3.0, 4.0, 0.5)))
    told = browser_knows(dashboard)["selection"]
    assert told["tree"] == 12
    assert told["cluster"] == {"scan": 231, "cluster": 4, "verdict": "too long", "x": 3.0, "y": 4.0}
    await dashboard.receive(Shown(1, 9.0, frame(900, 9), 0, path([0.0])))
    assert await dashboard.selector.story(231, 4) == cluster_story()  # the worker is not asked again
    await dashboard.select_tree(None)
    assert browser_knows(dashboard)["selection"]["cluster"] is None


async def test_a_cluster_that_is_not_known_any_more_selects_nothing_and_says_so(
    dashboard: Dashboard,
) -> None:
    await dashboard.receive(opened())
    await dashboard.receive(Shown(1, 0.0, frame(231, 0), 0, path([0.0])))
    await dashboard.select_tree(4)
    dashboard.selector.cluster_soon(2, 4)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    (question,) = [m for m in worker(dashboard).commands if isinstance(m, AskCluster)]
    await dashboard.receive(Answer(question.ticket, missing="scan 2 was shown too long ago"))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert browser_knows(dashboard)["missing"]["detail"] == "scan 2 was shown too long ago"
    assert dashboard.selector.selection.tree == 4


async def test_a_loop_goes_round_once_at_its_end_and_again_after_its_beginning(dashboard: Dashboard) -> None:
    await dashboard.receive(opened())
    dashboard.loop.choose((1.0, 2.0))
    assert browser_knows(dashboard)["loop"]["to_s"] == 2.0

    async def played(state: Any, *times: float) -> list[Any]:
        before = len(worker(dashboard).commands)
        await dashboard.receive(Report(Status(state)))
        for index, time_s in enumerate(times):
            await dashboard.receive(Shown(1, time_s, frame(index, index), 0, path([0.0])))
        return worker(dashboard).commands[before:]

    assert await played("playing", 1.5, 2.0, 2.1) == [Seek(1.0)]
    assert await played("playing", 1.0, 1.9, 2.3) == [Seek(1.0)]
    assert await played("paused", 1.0, 2.5) == []  # who stands beyond the end stays there
    assert await played("finished", 1.0, 2.5) == [Seek(1.0), Play()]
    dashboard.loop.choose(None)
    assert await played("playing", 1.0, 9.0) == []
    dashboard.loop.choose((1.0, 2.0))
    await dashboard.open(Open("other:"))
    assert browser_knows(dashboard)["loop"]["value"] is None


async def test_detections_are_counted_again_when_the_references_change(dashboard: Dashboard) -> None:
    await dashboard.receive(opened(run=1, truth=truth_trees()))
    picture = frame(1, 5_100_000_000, x=1.0)
    found = replace(
        picture.detections,
        cluster=np.zeros(1, np.int64),
        centre=picture.estimate.T_map_base.inverse().apply(np.array([[9.0, 0.0]])),
        covariance=np.eye(2)[None],
        radius=np.array([0.1]),
        radius_sigma=np.array([0.01]),
        arc=np.array([1.0]),
        eccentricity=np.array([2.0]),
    )
    await dashboard.receive(Shown(1, 0.1, replace(picture, detections=found), 0, path([0.0, 1.0])))

    def counted() -> dict[str, Any]:
        newest = dashboard.live.map_after(0)
        assert newest is not None
        shown: dict[str, Any] = json.loads(newest[1])
        return {name: shown[name] for name in ("index", "right", "wrong")}

    assert counted() == {"index": 1, "right": 0, "wrong": 1}
    editor, author = dashboard.annotation_editor, Author("b" * 16, "Ann")
    run = editor.run
    assert run is not None
    await editor.edit(run, lambda store: store.add(run, author, [Content(9.0, 0.0, "tree")]))
    assert counted() == {"index": 1, "right": 1, "wrong": 0}
