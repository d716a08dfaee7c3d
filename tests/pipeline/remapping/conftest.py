"""The run of `mapped`, mapped with its preset."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import pytest

from pipeline.remapping.preview import ClusterTable, KnownMap
from pipeline.remapping.rerun import ScanCache, ScanCaches
from tests.pipeline.remapping.mapped import BASE, mapper, run


@pytest.fixture(scope="session")
def known() -> Iterator[tuple[ScanCache, KnownMap]]:
    """The cache of all scans, and the map."""
    m, clusters, frame = mapper(BASE), ClusterTable(), None
    with closing(ScanCaches()) as caches:
        cache = caches.of(BASE)
        for step in run()[0]:
            scan = m.segment(step)
            cache.put(step, scan)
            frame = m.process(step, scan)
            clusters.record(frame)
        assert frame is not None
        yield cache, KnownMap(BASE, clusters, m.path, frame.columns)
