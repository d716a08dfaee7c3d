"""Pictures of a camera over plain DDS."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.io.recording.rendering import CAMERA
from pipeline.types.records import Scan
from tests.app.extensions.dds.fast_dds import Peer, messages_of
from tests.app.extensions.dds.test_dds import DOMAIN
from tests.app.robot.conftest import listening, until
from tests.app.robot.test_live_camera import _has_picture


@pytest.mark.slow
def test_pictures_arrived_over_plain_dds(run: Path):
    pytest.importorskip("cyclonedds", reason="cyclonedds, an extra, is not installed")
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    from app.extensions.dds.link import idl_type

    with closing(listening(f"dds:?domain={DOMAIN}")) as source:
        participant, writers = DomainParticipant(DOMAIN), dict[str, Any]()
        for topic, msgtype, _ in messages_of(run, one_each=True):
            held = [Policy.Durability.TransientLocal] if topic.endswith("tf_static") else []
            qos = Qos(Policy.Reliability.Reliable(60 * 10**9), Policy.History.KeepAll, *held)
            written: Any = Topic(participant, f"rt{topic}", idl_type(msgtype))
            writers[topic] = DataWriter(participant, written, qos)
        until(lambda: source.listen() or all(w.get_matched_subscriptions() for w in writers.values()))
        for topic, msgtype, payload in messages_of(run):
            writers[topic].write(idl_type(msgtype).deserialize(payload))
            source.take()

        def known() -> bool:
            source.take()
            return source.ready and source.camera()[0] is not None

        until(known, source.waiting_for)
        camera, _ = source.camera()
        assert camera is not None
        np.testing.assert_allclose(camera.K, CAMERA.K)
        until(lambda: "of 0 pictures" not in source.picture_counts, lambda: source.picture_counts)
        writers.clear()
        del participant


@pytest.mark.slow
def test_the_pictures_of_a_robot_of_fast_dds_are_seen(fast_dds: Path, run: Path):
    pytest.importorskip("cyclonedds", reason="cyclonedds, an extra, is not installed")
    with closing(Peer(fast_dds, DOMAIN, run)) as robot, closing(listening(f"dds:?domain={DOMAIN}")) as source:
        robot.announce(reliable=True)
        until(lambda: source.listen() or "announced and silent" in source.waiting_for(), source.waiting_for)
        for topic in dict.fromkeys(message[0] for message in robot.messages):
            robot.matched(topic)
        robot.send(100_000)
        scans: list[Scan] = []

        def seen() -> bool:
            scans.extend(record for record in source.take() if isinstance(record, Scan))
            return any(_has_picture(source, scan) for scan in scans) and source.camera()[0] is not None

        until(seen, source.waiting_for)
        camera, why = source.camera()
        assert camera is not None, why
        np.testing.assert_allclose(camera.K, CAMERA.K)
        np.testing.assert_allclose(camera.T_base_camera.t, CAMERA.T_base_camera.t)
