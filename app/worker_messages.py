"""What the worker tells the web process, beside `Status`. Plain data: it travels as msgpack."""

from __future__ import annotations

import msgspec

from app.messages import Command, Status
from pipeline.records import Frame, Path, TruthTrees


class Opened(msgspec.Struct, frozen=True, tag="opened"):
    """A source was opened and waits for its first command.

    Attributes:
        uri: As the user wrote it.
        kind: The format in words.
        preset: The preset that suits this kind of source.
        scans: Number of scans, None where it is not known.
        end_s: Time of the last scan since the first, None where it is not known.
        truth: What is known for certain to stand there, or None.
    """

    uri: str
    kind: str
    preset: str
    scans: int | None
    end_s: float | None
    truth: TruthTrees | None


class Shown(msgspec.Struct, frozen=True, tag="shown"):
    """The picture of a scan. The path comes in pieces: cut what is there to `path_start` rows, then
    append `path`.

    Attributes:
        run: Counts the sources opened by this worker; tells late pictures of an older run apart.
        time_s: Of the scan since the run's first one.
        frame: All that came of the scan.
        path_start: How many rows of the path sent before still hold.
        path: The rows from there on.
    """

    run: int
    time_s: float
    frame: Frame
    path_start: int
    path: Path


class Report(msgspec.Struct, frozen=True, tag="report"):
    """How the run goes."""

    status: Status


FromWorker = Opened | Shown | Report
ToWorker = Command
