"""The worker's process with a fake mapper: `python -m tests.app.fake_worker`.

`fake:N` has N scans, `prints:N` prints while it is opened, `hangs:` never comes back.
"""

from __future__ import annotations

import threading

from app.worker.process import run_as_worker
from app.worker.session import Session
from pipeline.config import Parameters
from pipeline.errors import SourceError
from pipeline.io.readers.base import Source, SourceOptions
from tests.app.fakes import FakeSource, make_mapper


def open_source(uri: str, _options: SourceOptions) -> Source:
    name, _, scans = uri.partition(":")
    if name == "missing":
        raise SourceError("there is no such file", where=uri)
    if name == "hangs":
        threading.Event().wait()
    if name == "prints":
        print("a library greets" * 1000, flush=True)
    return FakeSource(int(scans), uri=uri)


if __name__ == "__main__":
    run_as_worker(
        Session(
            open_source=open_source,
            make_mapper=make_mapper,
            parameters=Parameters(),
        )
    )
