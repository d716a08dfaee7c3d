"""Two sets on one scan leave no trace in the run; what the page draws itself arrives as it was packed."""

from __future__ import annotations

import json
import queue
from typing import Any

import numpy as np
import pytest

from app.dashboard.payload import binary_payload, in_centimetres, stages_payload
from app.worker.loop import WorkerLoop
from app.worker.process import new_session
from app.worker.protocol import Answer, AskCompare, FromWorker, Open, Shown, ToWorker
from app.worker.session import Session
from pipeline.config import Parameters, preset
from pipeline.errors import StemmapError
from pipeline.types.records import Frame
from tests.app.fakes import FakeSource, FakeWorker, frame, make_session, opened, path, truth_trees
from tests.app.server_for_tests import Running
from tests.app.worker.test_real_session import assert_same, stand_at


def unpacked(block: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """As the page reads it."""
    length = int.from_bytes(block[:4], "little")
    header = json.loads(block[4 : 4 + length])
    body = block[4 + length :]
    arrays = {}
    for entry in header.pop("arrays"):
        assert (4 + length + entry["at"]) % 4 == 0  # or the page's arrays could not lie on it
        count = int(np.prod(entry["shape"]))
        arrays[entry["name"]] = np.frombuffer(body, entry["type"], count, entry["at"]).reshape(entry["shape"])
    return header, arrays


def frames_of(session: Session, after: int) -> list[Frame]:
    return [stand_at(session, index) for index in range(after + 1, after + 6)]


def test_a_comparison_leaves_no_trace_in_the_run():
    session, other = new_session(), new_session()
    for each in (session, other):
        each.open(Open("sim:stand?duration=3", "auto", 3))
        stand_at(each, 12)
    sets = [preset("paper"), preset("forest"), Parameters().replace({"clustering.eps": 0.6})]
    compared = session.compare(sets)
    assert_same(compared[1], other.shown.frame)  # type: ignore[arg-type]
    assert len(compared[0].clusters.size) != len(compared[1].clusters.size)
    assert_same(session.compare(sets[1:])[0], compared[1])
    for with_it, without in zip(frames_of(session, 12), frames_of(other, 12), strict=True):
        assert_same(with_it, without)
    assert session.shown.path is not None
    assert other.shown.path is not None
    np.testing.assert_array_equal(session.shown.path.sigma_xy, other.shown.path.sigma_xy)
    session.close()
    other.close()


def test_what_is_compared_is_not_measured_and_a_failure_leaves_the_run_whole():
    session = make_session(FakeSource(6))
    with pytest.raises(StemmapError, match="nothing is mapped"):
        session.compare([Parameters()])
    session.open(Open("fake:", "auto", 0))
    with pytest.raises(StemmapError, match="no scan is mapped yet"):
        session.compare([Parameters()])
    first = stand_at(session, 2)
    run = session.run
    assert run is not None
    before = dict(run.stopwatch.stage_ms)
    session.compare([Parameters().replace({"clustering.eps": 0.3})])
    assert run.stopwatch.stage_ms == before
    with pytest.raises(AttributeError):
        session.compare([None])  # type: ignore[list-item]
    stand_at(session, 3)
    assert stand_at(session, 2).estimate.T_map_base == first.estimate.T_map_base


def test_the_worker_answers_with_pictures_without_raw_points():
    waiting: queue.Queue[ToWorker | None] = queue.Queue()
    said: list[FromWorker] = []
    session = make_session(FakeSource(4))
    session.open(Open("fake:", "auto", 0))
    stand_at(session, 1)
    values = [Parameters().model_dump(), {**Parameters().model_dump(), "slam": {"particles": -1}}]
    for message in (AskCompare(1, 0, values[:1]), AskCompare(2, 0, values), AskCompare(3, 5, []), None):
        waiting.put(message)
    WorkerLoop(session, waiting, said.append).run()
    answers = {message.ticket: message for message in said if isinstance(message, Answer)}
    assert [(len(f.raw), f.index) for f in answers[1].frames or []] == [(0, 1)]
    assert "slam.particles" in answers[2].missing
    assert "another run was opened" in answers[3].missing


def test_a_block_is_read_as_it_was_packed():
    arrays: dict[str, np.ndarray] = {
        "a": np.arange(5, dtype=np.int16),
        "b": np.ones((2, 3), np.float32),
        "c": np.zeros(0, np.int32),
    }
    header, read = unpacked(binary_payload({"index": 3, "name": "Bäume"}, arrays))
    assert header == {"index": 3, "name": "Bäume"}
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype


def test_points_are_whole_centimetres():
    points = np.array([[1.234, -0.006, 0.0], [1e6, -1e6, 327.0]], np.float32)
    assert in_centimetres(points).tolist() == [[123, -1, 0], [32767, -32767, 32700]]


def test_the_stages_have_the_points_of_each():
    picture = frame(2, 5_200_000_000, x=1.0, n_trees=4)
    header, arrays = unpacked(stages_payload(picture))
    assert (len(arrays["raw"]), len(arrays["points"]), len(arrays["labels"])) == (5, 4, 4)
    assert len(arrays["circles"]) == len(header["clusters"]["x"])
    assert header["counts"] == {"returns": 5}


async def test_the_page_asks_for_stages_and_for_a_comparison(both: Running) -> None:
    client, dashboard = both
    assert (await client.get("/api/stages")).status_code == 409
    assert (await client.post("/api/compare", json={"a": "", "b": "paper"})).status_code == 409
    await dashboard.receive(opened(truth=truth_trees()))
    picture = frame(2, 5_200_000_000, x=1.0, n_trees=4)
    await dashboard.receive(Shown(1, 0.2, picture, 0, path([0.0, 0.5, 1.0])))
    assert unpacked((await client.get("/api/stages")).content)[0]["index"] == 2

    worker = dashboard.worker
    assert isinstance(worker, FakeWorker)
    send = worker.send

    async def answer(command: ToWorker, /) -> None:
        await send(command)
        if isinstance(command, AskCompare):
            await dashboard.receive(Answer(command.ticket, frames=[picture for _ in command.sets]))

    worker.send = answer  # type: ignore[method-assign, assignment]
    block = await client.post("/api/compare", json={"a": "", "b": "paper"})
    header, arrays = unpacked(block.content)
    assert {name for name, _, _ in header["differences"]} == set(preset("paper").changes_from(Parameters()))
    assert [each["index"] for each in header["pictures"]] == [2, 2]
    assert header["pictures"][0]["right"] == 0
    assert {"points0", "points1", "labels0", "circles1"} <= set(arrays)
    assert (await client.post("/api/compare", json={"a": "nowhere", "b": ""})).status_code == 404
