"""The open run as a folder of result files, so that the functions of the command line apply to it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from app.batch.map_frame import write_map_frame
from app.batch.run_edits import by_people_text, measured_by_people, reviews_of
from app.batch.run_folder import ByPeople, as_written, counted_dbh, recorded_time, score_map
from app.batch.summary import driven, far_truth, left_out_warning, unconfirmed_warning
from app.common.text import changed_values, version
from app.dashboard.selection import NothingMappedError
from app.sources.one_step import OneStep
from app.sources.request import SourceRequest
from app.store.records import Annotation
from app.worker.protocol import Shown, Status
from pipeline.config import Parameters
from pipeline.geometry.poses import Float, Pose2
from pipeline.io.atomic_files import write_texts
from pipeline.io.result_files import (
    BY_PEOPLE,
    PATH_COLUMNS,
    REJECTED,
    TERRAIN_COLUMNS,
    TREE_COLUMNS,
    csv_in_units,
    csv_text,
    number_text,
    path_rows,
    seen_text,
    terrain_rows,
    tree_rows,
)
from pipeline.repairs.record import repairs_record
from pipeline.seen_area import SeenArea, SeenRecorder, covered_area
from pipeline.types.records import Path, Trees, TruthTrees

if TYPE_CHECKING:
    from app.dashboard.annotations import Counted
    from app.dashboard.dashboard import Dashboard


@dataclass(frozen=True, slots=True, eq=False)
class ShownRun:
    """The open run at one moment; its parts are of one run, also if another source is opened meanwhile.

    Attributes:
        request: Source with seed and odometry.
        digest: Digest of the recording, or its URI.
        status: Status of the worker.
        shown: Newest results.
        path: The estimated path.
        start_ns: Time of the first scan [ns].
        preset, parameters: In force.
        truth: Ground truth in the frame of the map; None if there is none.
        seen: Views of the observed area; those of later scans may be added.
        edits: The annotations, also those of skipped trees and of extensions.
        frame: The reference system that a user gave the map on the dashboard, as annotation; None if there is
            none.
        recordings: Absolute paths of the files to which a live run was recorded.
        references: What `truth` consists of, see `counted` of `app.dashboard.annotations`.
    """

    request: SourceRequest
    digest: str
    status: Status
    shown: Shown
    path: Path
    start_ns: int
    preset: str
    parameters: Parameters
    truth: TruthTrees | None
    seen: SeenRecorder
    edits: tuple[Annotation, ...]
    frame: Annotation | None
    recordings: tuple[str, ...] = ()
    references: Counted = "source"

    @classmethod
    def of(cls, dashboard: Dashboard) -> ShownRun:
        """Return the present state of a dashboard; raises NothingMappedError before the first map."""
        if dashboard.shown is None or dashboard.path is None:
            raise NothingMappedError
        state, editor = dashboard.parameters, dashboard.annotation_editor
        return cls(
            dashboard.source,
            dashboard.digest,
            dashboard.status,
            dashboard.shown,
            dashboard.path,
            dashboard.start_ns,
            state.preset,
            state.parameters,
            dashboard.truth,
            dashboard.seen,
            (*editor.rows, *editor.skipped, *editor.others),
            editor.frame,
            dashboard.run_recorder.recordings,
            editor.used,
        )

    @property
    def distance_m(self) -> float:
        """Driven distance [m], rounded to 1 mm."""
        return round(driven(self.path)[1], 3)

    @property
    def one_step(self) -> OneStep | None:
        """What is known of a source that is mapped in one step; None for a drive."""
        return self.status.one_step

    @property
    def offset(self) -> tuple[float, ...]:
        """Offset of the frame of the map in the coordinates of the files [m]."""
        return self.one_step.offset if self.one_step else (0.0, 0.0, 0.0)

    def reviews(self) -> dict[int, str]:
        """Return a dict from the number of each confirmed tree that has a review to this review, see
        `reviews_of`."""
        return reviews_of(*self._numbered(), [row.content for row in self.edits])

    def _numbered(self) -> tuple[list[int], Float]:
        """Return the numbers and positions of the confirmed trees in the frame of the map."""
        trees = self.shown.frame.trees
        return trees.number[trees.confirmed].tolist(), trees.position[trees.confirmed]

    def by_people(self) -> ByPeople:
        """Return what people measured of the confirmed trees, in the frame of the map."""
        return measured_by_people(*self._numbered(), [row.content for row in self.edits])

    def _by_people_files(self, people: ByPeople) -> dict[str, str]:
        """Return a dict from the name by_people.csv to its text; an empty dict without rows."""
        numbers, position = self._numbered()
        offset = np.array(self.offset[:2])
        placed = replace(people, added=people.added + offset)
        text = by_people_text(placed, numbers, position + offset)
        return {BY_PEOPLE: self._in_units(text)} if text else {}

    def trees_text(self, people: ByPeople) -> str:
        """Return the text of trees.csv: the confirmed trees, also rejected ones, with their reviews, in the
        coordinates of the files; where any was measured by tape, with `dbh_tape_cm`, `dbh_counted_cm`,
        `sigma_dbh_counted_cm` and `dbh_source`, see `counted_dbh`; with a reference system also their
        `easting_m` and `northing_m` in it. `people` is the result of `by_people`."""
        trees = in_file(self.shown.frame.trees, self.one_step)
        names, rows = TREE_COLUMNS, tree_rows(trees, self.start_ns, self.reviews())
        if people.tape:
            names = (*names, "dbh_tape_cm", "dbh_counted_cm", "sigma_dbh_counted_cm", "dbh_source")
            tape = people.tape_of(self._numbered()[0])
            dbh, sigma = trees.dbh[trees.confirmed], trees.dbh_sigma[trees.confirmed]
            *counted, source = counted_dbh(tape, dbh, sigma)
            texts = ([number_text(100.0 * value, 1) for value in column] for column in (tape, *counted))
            rows = [(*row, *more) for row, *more in zip(rows, *texts, source.tolist(), strict=True)]
        if self.frame is not None and self.frame.content.values is not None:
            given = self.frame.content.values["frame"]
            pose = Pose2(given["east_m"], given["north_m"], given["turn_rad"])
            names = (*names, "easting_m", "northing_m")
            place = pose.apply(trees.position[trees.confirmed]).tolist()
            rows = [(*row, *(number_text(v, 3) for v in at)) for row, at in zip(rows, place, strict=True)]
        return self._in_units(csv_text(names, rows))

    def _in_units(self, text: str) -> str:
        """Return a CSV text with positions in the units of the reference system of the file."""
        return text if self.one_step is None else csv_in_units(text, self.one_step.crs_unit)

    @contextmanager
    def folder(self, *, with_seen: bool = True) -> Iterator[FilePath]:
        """Write the run to a temporary folder, as `stemmap map` does, with the reference system that a user
        gave the map, and yield it; it is removed afterwards. Raises StemmapError if a file cannot be written,
        and OSError without a place for the folder.

        Args:
            with_seen: Whether to write seen.csv, which takes milliseconds for each view of a drive.
        """
        with TemporaryDirectory(prefix="stemmap-run-") as name:
            write_texts(FilePath(name), self.texts(with_seen=with_seen))
            if self.frame is not None and self.frame.content.values is not None:
                write_map_frame(FilePath(name), self.frame.content.values["frame"])
            yield FilePath(name)

    def texts(self, *, with_seen: bool = True) -> dict[str, str]:
        """Return a dict from the names trees.csv, path.csv, seen.csv (only if `with_seen`), by_people.csv (if
        people measured trees), terrain.csv and run.json to the texts of these files. terrain.csv has only its
        header if the newest results have no ground."""
        ground, offset, people = self.shown.frame.ground, self.offset, self.by_people()
        cells = [] if ground is None else list(terrain_rows(ground))
        if self.one_step is not None:
            cells = [
                [*(number_text(float(v) + o, 3) for v, o in zip(row, offset, strict=False)), "", ""]
                for row in cells
            ]
        return {
            "trees.csv": self.trees_text(people),
            "path.csv": csv_text(PATH_COLUMNS, path_rows(self.path, self.start_ns)),
            **({"seen.csv": self._in_units(seen_text(self._seen_area()))} if with_seen else {}),
            **self._by_people_files(people),
            "terrain.csv": self._in_units(csv_text(TERRAIN_COLUMNS, cells)),
            "run.json": json.dumps(self._record(), indent=1) + "\n",
        }

    def _seen_area(self) -> SeenArea:
        """Return the observed area in the coordinates of the files: what the scans saw, or what the points
        of a source of one step cover."""
        if self.one_step is None:
            return self.seen.area(self.path)
        counts = self.shown.counts
        covered = np.zeros((0, 2)) if counts is None or counts.covered is None else counts.covered
        return covered_area(covered + self.one_step.offset[:2])

    def _record(self) -> dict[str, Any]:
        """Return the content of run.json as a dict.

        The keys are `stemmap` (version); `source`, a dict with `uri`, `kind`, `sha256` ("" if the recording
        has no digest) and, for a source of one step, those of `OneStep`; `recorded` and `chosen` where known;
        `recordings` of a live run, if there are any; `seed`, `odometry`, `preset`, `changed` and
        `parameters`; `scans` (0 without a drive), `duration_s` and `distance_m`; `trees`, without the
        rejected ones, and `rejected`, their number; `evaluation`, which reviews do not change, None without
        ground truth; `references`, "annotations" or "both" if its ground truth has annotations; `repairs`,
        see `repairs_record`, if there are any; and those of `_counts`."""
        status, truth = self.status, truth_in_file(self.truth, self.one_step)
        trees = in_file(self.shown.frame.trees, self.one_step)
        rejected = sum(review == REJECTED for review in self.reviews().values())
        scores = None
        if truth is not None:
            scores = asdict(score_map(*as_written(trees, self.path, self.start_ns), truth, self.parameters))
        digest = "" if self.digest == self.request.uri else self.digest
        source: dict[str, Any] = {"uri": self.request.uri, "kind": status.kind, "sha256": digest}
        if self.one_step is not None:
            source |= {"offset_m": list(self.one_step.offset), "crs": self.one_step.crs or None}
            source |= {"unit": self.one_step.unit, "up": self.one_step.up}
            if self.one_step.crs_unit != (1.0, 1.0):
                source["crs_unit_m"] = list(self.one_step.crs_unit)
        repairs = {}
        if self.shown.repairs:
            repairs = {"repairs": repairs_record(self.shown.repairs, self.shown.problems)}
        return {
            "stemmap": version(),
            "source": source,
            **({} if self.one_step else recorded_time(status.kind, self.start_ns)),
            **({"recordings": list(self.recordings)} if self.recordings else {}),
            "seed": self.request.seed,
            "odometry": self.request.odometry,
            **({} if (chosen := self.request.kept_choices()) is None else {"chosen": chosen}),
            "preset": self.preset,
            "changed": changed_values(self.preset, self.parameters),
            "parameters": self.parameters.model_dump(),
            "scans": 0 if self.one_step else self.shown.frame.index + 1,
            "duration_s": round(self.shown.time_s, 6),
            "distance_m": self.distance_m,
            "trees": int(np.count_nonzero(trees.confirmed)) - rejected,
            "rejected": rejected,
            "evaluation": scores,
            **({"references": self.references} if self.references in ("annotations", "both") else {}),
            **repairs,
            **self._counts(scores),
        }

    def warnings(self, *of_scores: str) -> list[str]:
        """Return the warnings of run.json in their order; those of the status if the counts are unknown.

        Args:
            of_scores: Warnings about the scores of a drive.
        """
        counts = self.shown.counts
        if counts is None:
            return list(self.status.warnings)
        warnings = list(counts.warnings)
        if self.one_step is None:
            warnings += of_scores
            if unconfirmed := unconfirmed_warning(self.shown.frame, self.parameters):
                warnings.append(unconfirmed)
            if left_out := left_out_warning(counts.losses, self.shown.frame.index + 1):
                warnings.append(left_out)
        return warnings

    def _counts(self, scores: dict[str, Any] | None) -> dict[str, Any]:
        """Return a dict with `health` (not without a drive), `verdicts`, `losses` and `warnings` of
        run.json, as `stemmap map` writes them, but `health` has no spans and of the worst values at most
        `sigma_xy_m`; only `warnings`, those of the status, if the counts are unknown.

        Args:
            scores: Scores of the map as a dict, see `MapScores`; None if there is no ground truth.
        """
        counts = self.shown.counts
        if counts is None:
            return {"warnings": self.warnings()}
        of_scores = []
        if scores is not None and scores["TA"]["of"] + scores["TR"]["of"] == 0:
            of_scores.append(far_truth(scores["reach"]))
        worst = {} if counts.sigma_xy_m is None else {"sigma_xy_m": counts.sigma_xy_m}
        return {
            **({"health": {"scans": counts.health, "worst": worst}} if counts.health else {}),
            "verdicts": counts.verdicts,
            "losses": counts.losses,
            "warnings": self.warnings(*of_scores),
        }


def in_file(trees: Trees, one_step: OneStep | None) -> Trees:
    """Return a copy of trees in the coordinates of the file of a source of one step; for a drive (None) the
    trees themselves."""
    return trees if one_step is None else replace(trees, position=trees.position + one_step.offset[:2])


def truth_in_file(truth: TruthTrees | None, one_step: OneStep | None) -> TruthTrees | None:
    """Return ground truth in the coordinates of the file of a source of one step; None for None. For a
    drive it is the ground truth itself."""
    if truth is None or one_step is None:
        return truth
    return replace(truth, x=truth.x + one_step.offset[0], y=truth.y + one_step.offset[1])
