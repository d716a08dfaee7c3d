"""Sliders: moved by a person they ask the server, moved from code they are silent."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from viser import _messages

from app.scene import Scene
from app.scene.viser_server import set_value
from pipeline.config import Parameters, field_specs, preset
from tests.app.scene.recorder import Recorder, Refusing


class Person:
    """A browser's client as viser's callbacks see it."""

    client_id = 0

    def __init__(self) -> None:
        self.told: list[str] = []

    def add_notification(self, _title: str, body: str, **_look: object) -> None:
        self.told.append(body)


async def moved(scene: Scene, name: str, value: float | int | bool | str) -> Person:
    """Move a slider as viser does when a browser says so, in viser's own thread."""
    return await acted(scene, scene._tune._widgets[name], value)


async def acted(scene: Scene, widget: Any, value: float | int | bool | str) -> Person:
    """Use any widget of the panel in this way."""
    person = Person()
    server = scene._server
    server._connected_clients[0] = person  # type: ignore[assignment]
    message = _messages.GuiUpdateMessage(widget._impl.uuid, {"value": value})
    handlers = server._websock_server._incoming_handlers[_messages.GuiUpdateMessage]
    for handler in handlers:
        future = asyncio.run_coroutine_threadsafe(handler(0, message), server._event_loop)  # type: ignore[arg-type]
        await asyncio.wrap_future(future)
    await until(lambda: not scene._tuning._busy and not scene._tuning._tasks)
    return person


async def until(condition) -> None:
    async with asyncio.timeout(10):
        while not condition():
            await asyncio.sleep(0.005)


async def test_there_is_a_slider_for_each_main_parameter(scene: Scene):
    specs = [spec for spec in field_specs() if spec.main]
    assert len(specs) == 12
    assert len({(spec.title, spec.unit) for spec in specs}) == 12  # the page finds them by their labels
    for spec in specs:
        widget: Any = scene._tune._widgets[spec.name]
        assert spec.title in widget.label
        assert spec.unit in widget.label
        assert (widget.min, widget.max) == spec.shown


async def test_a_slider_reaches_a_value_beyond_its_range(scene: Scene):
    slider: Any = scene._tune._widgets["clustering.eps"]
    scene.show_parameters(preset("forest").replace({"clustering.eps": 4.0}), "forest")
    assert (slider.min, slider.max, slider.value) == (0.05, 4.0, 4.0)
    scene.show_parameters(preset("forest"), "forest")
    assert (slider.min, slider.max) == (0.05, 1.0)


async def test_a_person_changes_a_parameter(scene: Scene, recorder: Recorder):
    await moved(scene, "clustering.eps", 0.15000000000000002 + 0.1)
    assert recorder.asked == [("change", {"clustering.eps": 0.25})]
    await moved(scene, "clustering.min_points", 12)
    assert type(recorder.asked[1][1]["clustering.min_points"]) is int


async def test_a_value_set_from_code_does_not_come_back(scene: Scene, recorder: Recorder):
    scene.show_parameters(preset("paper"), "paper")
    assert scene._tune._widgets["clustering.eps"].value == 0.25
    await asyncio.sleep(0)
    await until(lambda: not scene._tuning._tasks)
    assert recorder.asked == []


async def test_what_differs_from_the_preset_is_marked(scene: Scene):
    changed = preset("forest").replace({"clustering.eps": 0.3})
    scene.show_parameters(changed, "forest")
    assert scene._tune._widgets["clustering.eps"].label.startswith("● ")
    assert not scene._tune._widgets["clustering.min_points"].label.startswith("● ")
    assert "**1** value differs" in scene._tune._summary.content
    scene.show_parameters(preset("forest"), "forest")
    assert not scene._tune._widgets["clustering.eps"].label.startswith("● ")


async def test_a_refused_value_goes_back_and_the_person_is_told():
    recorder = Refusing()
    scene = Scene(recorder, asyncio.get_running_loop())
    try:
        person = await moved(scene, "filters.x_min", 90.0)
        assert person.told == ["refused for the test"]
        assert scene._tune._widgets["filters.x_min"].value == Parameters().filters.x_min
    finally:
        scene.close()


async def test_while_one_change_is_under_way_only_the_newest_waits(scene: Scene, recorder: Recorder):
    go = asyncio.Event()
    first = recorder.change_parameters

    async def slow(changes):
        await go.wait()
        await first(changes)

    recorder.change_parameters = slow  # type: ignore[method-assign]
    for eps in (0.2, 0.3, 0.4, 0.5):
        scene._tuning.change("clustering.eps", eps, None)
        await asyncio.sleep(0)
    # What the server says about the first change does not pull the slider away from the hand.
    set_value(scene._tune._widgets["clustering.eps"], 0.5)
    scene.show_parameters(preset("forest").replace({"clustering.eps": 0.2}), "forest")
    assert scene._tune._widgets["clustering.eps"].value == 0.5
    go.set()
    await until(lambda: not scene._tuning._busy)
    assert recorder.asked == [("change", {"clustering.eps": 0.2}), ("change", {"clustering.eps": 0.5})]


@pytest.mark.parametrize("value", ["not a number", None, [1, 2]])
async def test_a_value_of_another_kind_is_dropped(scene: Scene, recorder: Recorder, value: object):
    await moved(scene, "clustering.eps", value)  # type: ignore[arg-type]
    assert recorder.asked == []
    assert scene._tune._widgets["clustering.eps"].value == 0.15


async def test_presets_and_resets_are_asked_for(scene: Scene, recorder: Recorder):
    await acted(scene, scene._tune._preset, "paper")
    await acted(scene, scene._tune._reset, True)
    await until(lambda: len(recorder.asked) == 2)
    assert recorder.asked == [("preset", "paper"), ("reset", [])]


async def test_a_click_on_a_tree_selects_it_and_another_lets_it_go(scene: Scene, recorder: Recorder):
    scene._on_tree(4)
    await until(lambda: len(recorder.asked) == 1)
    scene.select(4)
    scene._on_tree(4)
    await until(lambda: len(recorder.asked) == 2)
    assert recorder.asked == [("select", 4), ("select", None)]
