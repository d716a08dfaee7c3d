"""What the worker and the web process say beside `Status` and the commands of people. Plain data: it
travels as msgpack."""

from __future__ import annotations

from typing import Any

import msgspec

from app.dashboard.map_changes import MapChanges
from app.explain.records import ClusterStory, TreeStory
from app.worker.camera import CameraPicture
from app.worker.protocol import Command, Status
from pipeline.types.records import Float, Frame, Path, Trees, TruthTrees


class Opened(msgspec.Struct, frozen=True, tag="opened"):
    """A source was opened and waits for `Begin`.

    Attributes:
        run: Counts the sources opened by this worker.
        uri: As the user wrote it.
        kind: The format in words.
        preset: The preset that suits this kind of source.
        scans: Number of scans, None where it is not known.
        end_s: Time of the last scan since the first, None where it is not known.
        truth: What is known for certain to stand there, or None.
        digest: Of what was recorded; empty where it is not known.
        asked: The URI of the `Open` that this answers; empty where it is not known.
    """

    uri: str
    kind: str
    preset: str
    scans: int | None
    end_s: float | None
    truth: TruthTrees | None
    run: int = 0
    digest: str = ""
    asked: str = ""


class Shown(msgspec.Struct, frozen=True, tag="shown"):
    """The picture of a scan. The path comes in pieces: cut what is there to `path_start` rows, then
    append `path`.

    Attributes:
        run: Counts the sources opened by this worker; tells late pictures of an older run apart.
        time_s: Of the scan since the run's first one.
        frame: All that came of the scan.
        path_start: How many rows of the path sent before still hold.
        path: The rows from there on.
        confirmed_s: When each tree of the frame was confirmed, NaN where that is not known; None knows none.
            Not every scan is shown, so a picture alone does not tell it.
    """

    run: int
    time_s: float
    frame: Frame
    path_start: int
    path: Path
    confirmed_s: Float | None = None


class Report(msgspec.Struct, frozen=True, tag="report"):
    """How the run goes."""

    status: Status


class Begin(msgspec.Struct, frozen=True, tag="begin"):
    """The answer to `Opened`: begin with these parameters. Meant for one run: if another was opened since,
    it is left aside.

    Attributes:
        run: Of the `Opened` that is answered.
        values, revision: As in `SetParameters`.
        play: Play, unless a person has said otherwise since the opening; else show the first scan.
    """

    run: int
    values: dict[str, Any]
    revision: int
    play: bool


class AskCluster(msgspec.Struct, frozen=True, tag="ask_cluster"):
    """Tell the story of a cluster of a scan that was shown lately.

    Attributes:
        ticket: Comes back with the answer.
        run: That the scan is of.
        scan, cluster: Number of the scan, and of the cluster in it.
    """

    ticket: int
    run: int
    scan: int
    cluster: int


class AskTree(msgspec.Struct, frozen=True, tag="ask_tree"):
    """Tell the story of a tree as it stands.

    Attributes:
        ticket, run: As in `AskCluster`.
        tree: Its number.
    """

    ticket: int
    run: int
    tree: int


class AskCompare(msgspec.Struct, frozen=True, tag="ask_compare"):
    """Map the standing scan under other parameters; the run stays as it is.

    Attributes:
        ticket, run: As in `AskCluster`.
        sets: Parameters, already validated, as nested values.
    """

    ticket: int
    run: int
    sets: list[dict[str, Any]]


class AskCamera(msgspec.Struct, frozen=True, tag="ask_camera"):
    """Tell what the run's camera saw.

    Attributes:
        ticket, run: As in `AskCluster`.
        stamp_ns: About when.
    """

    ticket: int
    run: int
    stamp_ns: int


class Answer(msgspec.Struct, frozen=True, tag="answer"):
    """What was asked for.

    Attributes:
        ticket: Of the question.
        cluster, tree, frames, camera: One of them is told, unless `missing` says why there is none; the
            frames one for each set, without raw points.
        missing: Why there is none, and what to do.
    """

    ticket: int
    cluster: ClusterStory | None = None
    tree: TreeStory | None = None
    frames: list[Frame] | None = None
    camera: CameraPicture | None = None
    missing: str = ""


class Remapped(msgspec.Struct, frozen=True, tag="remapped"):
    """The run was mapped again: the pictures from here on are of another map.

    Attributes:
        run: As in `Shown`.
        changes: What is different.
    """

    run: int
    changes: MapChanges


class Rough(msgspec.Struct, frozen=True, tag="rough"):
    """Where trees will be, roughly, once the run is mapped again.

    Attributes:
        run: As in `Shown`.
        revision: Of the parameters.
        trees: Without diameters; their numbers hold for nothing else.
    """

    run: int
    revision: int
    trees: Trees


FromWorker = Opened | Shown | Report | Answer | Remapped | Rough
Question = AskCluster | AskTree | AskCompare | AskCamera
ToWorker = Command | Begin | Question
