"""Messages between worker and web process in addition to `Status` and the commands of people."""

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
        run: Number of sources that this worker has opened.
        uri: URI as written by the user.
        kind: Name of the format.
        preset: Preset for this kind of source.
        scans: Number of scans, None if unknown.
        end_s: Time of the last scan since the first [s], None if unknown.
        truth: Ground truth of the source, or None.
        digest: Digest of the recording, empty if unknown.
        asked: URI of the `Open` that this message answers, empty if unknown.
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
    """Displayed frame of a scan.

    The path is sent incrementally: the receiver cuts its path to `path_start` rows and appends `path`.

    Attributes:
        run: Number of the run, which identifies late frames of an older run.
        time_s: Time of the scan since the first scan of the run [s].
        frame: Results of the scan.
        path_start: Number of rows sent before that remain valid.
        path: Rows of the path from there on.
        confirmed_s: Confirmation time of each tree [s], NaN if unknown; None if all are unknown. Since not
            every scan is displayed, it does not follow from the frames.
    """

    run: int
    time_s: float
    frame: Frame
    path_start: int
    path: Path
    confirmed_s: Float | None = None


class Report(msgspec.Struct, frozen=True, tag="report"):
    """Status of the run."""

    status: Status


class Begin(msgspec.Struct, frozen=True, tag="begin"):
    """Answer to `Opened`: begin with these parameters; ignored if another run was opened meanwhile.

    Attributes:
        run: Number of the run in `Opened`.
        values, revision: As in `SetParameters`.
        play: Play unless a person has paused since the opening; else show the first scan.
    """

    run: int
    values: dict[str, Any]
    revision: int
    play: bool


class AskCluster(msgspec.Struct, frozen=True, tag="ask_cluster"):
    """Request the explanation of a cluster of a recently displayed scan.

    Attributes:
        ticket: Identifier that the answer repeats.
        run: Number of the run.
        scan, cluster: Index of the scan, and of the cluster in it.
    """

    ticket: int
    run: int
    scan: int
    cluster: int


class AskTree(msgspec.Struct, frozen=True, tag="ask_tree"):
    """Request the explanation of a tree.

    Attributes:
        ticket, run: As in `AskCluster`.
        tree: Number of the tree.
    """

    ticket: int
    run: int
    tree: int


class AskCompare(msgspec.Struct, frozen=True, tag="ask_compare"):
    """Request the current scan mapped with other parameter sets, without a change of the run.

    Attributes:
        ticket, run: As in `AskCluster`.
        sets: Parameter sets as validated nested values.
    """

    ticket: int
    run: int
    sets: list[dict[str, Any]]


class AskCamera(msgspec.Struct, frozen=True, tag="ask_camera"):
    """Request the camera picture.

    Attributes:
        ticket, run: As in `AskCluster`.
        stamp_ns: Approximate time of the picture [ns].
    """

    ticket: int
    run: int
    stamp_ns: int


class Answer(msgspec.Struct, frozen=True, tag="answer"):
    """Answer to a question.

    Attributes:
        ticket: Identifier of the question.
        cluster, tree, frames, camera: One of them is set unless `missing` is; `frames` has one frame per
            parameter set, without raw points.
        missing: Reason why there is no answer, and the remedy.
    """

    ticket: int
    cluster: ClusterStory | None = None
    tree: TreeStory | None = None
    frames: list[Frame] | None = None
    camera: CameraPicture | None = None
    missing: str = ""


class Remapped(msgspec.Struct, frozen=True, tag="remapped"):
    """The run was mapped again; the following frames belong to the new map.

    Attributes:
        run: As in `Shown`.
        changes: Differences between the maps.
    """

    run: int
    changes: MapChanges


class Rough(msgspec.Struct, frozen=True, tag="rough"):
    """Preview of the trees of the map that is being computed.

    Attributes:
        run: As in `Shown`.
        revision: Revision of the parameters.
        trees: Preview trees without diameters; their numbers are valid only in this message.
    """

    run: int
    revision: int
    trees: Trees


FromWorker = Opened | Shown | Report | Answer | Remapped | Rough
Question = AskCluster | AskTree | AskCompare | AskCamera
ToWorker = Command | Begin | Question
