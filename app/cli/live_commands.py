"""A command that maps a robot as it drives: it waits for the robot, and Ctrl-C ends the run well."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from pipeline.errors import SourceError

if TYPE_CHECKING:
    from app.robot.recorder import Recorder
    from app.robot.source import LiveSource
    from pipeline.config import Parameters
    from pipeline.io.readers import Source
    from pipeline.mapper import Mapper
    from pipeline.types.records import Frame

_TELL_S = 5.0


def recording_of(arguments: argparse.Namespace) -> Recorder | None:
    """The recording that the command line asks for.

    Raises:
        ParameterError: The source is no live one.
        SourceError: The file cannot be made.
    """
    from app.cli.flags import recording_place
    from app.robot.recorder import Recorder

    place = recording_place(arguments, arguments.source)
    return Recorder(Path(place)) if place else None


def begin_recording(source: Source | LiveSource, parameters: Parameters) -> None:
    """Say in the recording of a live run with which parameters it is mapped."""
    from app.robot.source import LiveSource

    if isinstance(source, LiveSource):
        source.use_parameters(0, 0, parameters)


def told_of_frames(source: Source | LiveSource) -> Callable[[Frame, Mapper], None] | None:
    """What a live source wants to know of each scan."""
    from app.robot.source import LiveSource

    return (
        (lambda frame, mapper: source.mapped(frame, mapper.path)) if isinstance(source, LiveSource) else None
    )


@contextmanager
def heard(
    source: Source | LiveSource,
    recording: Recorder | None = None,
    *,
    publish: bool = False,
    pictures: Path | None = None,
) -> Iterator[None]:
    """Of a live source: wait until it is heard; then Ctrl-C and SIGTERM end its records, and no more.

    Args:
        source: Live or not.
        recording: Of what comes.
        publish: Whether what comes of it is told to the robot's network.
        pictures: On whose disk pictures for its trees are put aside.

    Raises:
        SourceError: It was stopped before anything was heard, or what it sends cannot be read.
    """
    from app.robot.source import LiveSource
    from app.worker.numba_warmup import warm_up

    if not isinstance(source, LiveSource):
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        del number, frame
        source.stop()

    if pictures is not None:
        try:
            source.keep_pictures(pictures)
        except OSError as error:
            print(f"stemmap: there will be no pictures of trees: {error.strerror}", file=sys.stderr)
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    told = None
    try:
        source.start(recording, publish=publish)
        warm_up()
        told = _Teller(source)
        if not source.wait():
            raise SourceError("nothing was heard", where=source.uri, remedy=source.waiting_for())
        print(f"{source.uri} is heard; Ctrl-C ends the run and writes its files", file=sys.stderr, flush=True)
        yield
    finally:
        if told is not None:
            told.close()
        if source.recording:
            print(f"stemmap: {source.recording}", file=sys.stderr, flush=True)
        for number, handler in before.items():
            signal.signal(number, handler)


class _Teller:
    """Says every five seconds why nothing comes, and when a robot was lost or is back."""

    def __init__(self, source: LiveSource) -> None:
        self._source = source
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._tell, name="teller", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Say no more."""
        self._closed.set()
        self._thread.join()
        self._print(self._source.notices())

    def _tell(self) -> None:
        while not self._closed.wait(_TELL_S):
            self._print([*self._source.notices(), self._source.waiting_for()])

    @staticmethod
    def _print(lines: list[str]) -> None:
        for line in filter(None, lines):
            print(f"stemmap: {line}", file=sys.stderr, flush=True)
