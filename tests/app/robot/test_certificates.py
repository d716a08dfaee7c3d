"""A router with certificates and the access list of docs/zenoh.md: who comes in, and what each may do."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from app.robot.source import LiveSource, open_live
from app.robot.zenoh import configuration, data_key
from app.sources.live_address import ZenohAddress, parse_address
from pipeline.errors import SourceError
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.recording import messages
from tests.app.fakes import START_NS, frame, path
from tests.app.robot.certificates import Authority
from tests.app.robot.conftest import ROOT, free_port, listening, until
from tests.benchmarks.live_robot import Topic

zenoh: Any = pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of an authority, and one of another."""
    folder = tmp_path_factory.mktemp("certificates")
    authority = Authority(folder)
    for name in ("router", "robot1", "stemmap", "stranger"):
        authority.sign(name)
    Authority(folder, "other-ca").sign("forged")
    return folder


@pytest.fixture(scope="module")
def port(folder: Path) -> Iterator[int]:
    """A router with the configuration that the documentation shows."""
    text = (ROOT / "docs" / "zenoh.md").read_text(encoding="utf-8")
    shown = re.search(r"```json\n(.*?)```", text, re.DOTALL)
    assert shown is not None
    found = json.loads(shown[1])
    port = free_port()
    found["listen"]["endpoints"] = [f"tls/127.0.0.1:{port}"]
    tls = found["transport"]["link"]["tls"]
    tls.update({name: str(folder / place) for name, place in tls.items() if isinstance(place, str)})
    with zenoh.open(zenoh.Config.from_json5(json.dumps(found))):
        yield port


def files(folder: Path, name: str) -> dict[str, str]:
    own = {"cert": folder / f"{name}.pem", "key": folder / f"{name}-key.pem"} if name else {}
    return {role: str(place) for role, place in {"ca": folder / "ca.pem", **own}.items()}


def address(folder: Path, port: int, name: str) -> str:
    return f"zenoh:tls/127.0.0.1:{port}?" + "&".join(f"{k}={v}" for k, v in files(folder, name).items())


@contextmanager
def robot(folder: Path, port: int, drive: Path) -> Iterator[tuple[Any, Any]]:
    """A session of the robot with its topics, and what sends its first messages."""
    with closing(McapFile(drive)) as container:
        channels = {c.number: c for c in container.channels}
        messages = list(container.messages(list(channels), None, {}))
    config = configuration(f"tls/127.0.0.1:{port}", files(folder, "robot1"))
    with zenoh.open(zenoh.Config.from_json5(config)) as session:
        topics = {n: Topic(session, "robot1", n, c.topic, c.msgtype) for n, c in channels.items()}

        def send() -> None:
            for message in messages:
                topics[message.channel].put(message.payload)

        yield session, send


def test_with_its_certificate_stemmap_hears_the_robot_and_says_its_own_results(
    folder: Path, port: int, drive: Path
):
    heard: list[str] = []
    with (
        robot(folder, port, drive) as (session, send),
        closing(open_live(address(folder, port, "stemmap"))) as own,
    ):
        _listener = session.declare_subscriber("0/**", lambda sample: heard.append(str(sample.key_expr)))
        own.start(publish=True)
        until(lambda: own.listen() or "announced and silent" in own.waiting_for(), own.waiting_for)
        assert own.robots == ["robot1"]
        until(lambda: send() or own.listen(), own.waiting_for)
        pose = data_key(0, "/robot1/stemmap/pose", messages.TYPES["pose"], messages.type_hash("pose"))

        def said() -> bool:
            own.mapped(frame(0, START_NS), path([0.0, 1.0]))
            return pose in heard

        until(said)
        forbidden = data_key(0, "/robot1/cmd_vel", "geometry_msgs/msg/Twist", "RIHS01_0")
        own._link.session.put(forbidden, b"drive")
        heard.clear()
        until(said)  # what was put before would have come before
        assert forbidden not in heard


@pytest.mark.parametrize("name", ["", "forged"])
def test_without_a_certificate_of_the_authority_nobody_comes_in(folder: Path, port: int, name: str):
    with closing(listening(address(folder, port, name))) as source:
        until(lambda: "no connection" in source.waiting_for() or _is_dropped(source), source.waiting_for)
        assert source.robots == []


def test_a_certificate_that_is_not_on_the_list_hears_nothing(folder: Path, port: int, drive: Path):
    with (
        robot(folder, port, drive),
        closing(listening(address(folder, port, "stranger"))) as stranger,
        closing(listening(address(folder, port, "stemmap"))) as own,
    ):
        until(lambda: own.robots == ["robot1"], own.waiting_for)
        until(lambda: "no scans of a robot are announced" in stranger.waiting_for(), stranger.waiting_for)
        assert stranger.robots == []


def _is_dropped(source: LiveSource) -> bool:
    """Whether a session was opened that the router has left already."""
    session = source._link.session
    return session is not None and not list(session.info.routers_zid())


def test_what_is_wrong_with_the_files_is_said(folder: Path):
    here = f"zenoh:tls/h:7447?ca={folder}/ca.pem"
    with pytest.raises(SourceError, match="there is no such file"):
        parse_address(f"zenoh:tls/h:7447?ca={folder}/nothing.pem")
    with pytest.raises(SourceError, match="belong together"):
        parse_address(f"{here}&cert={folder}/stemmap.pem")
    with pytest.raises(SourceError, match="need an encrypted connection"):
        parse_address(here.replace("tls/", "tcp/"))
    router = parse_address(f"{here}&cert={folder}/stemmap.pem&key={folder}/stemmap-key.pem")
    assert isinstance(router, ZenohAddress)
