"""`stemmap map`: the whole mapping without a browser, as fast as it can."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli import flags
from pipeline.errors import SourceError

if TYPE_CHECKING:
    from app.batch.map_run import MappingResult
    from app.batch.saved_run import EarlierRun
    from app.robot.source import LiveSource
    from pipeline.io.readers import Source
    from pipeline.mapper import Mapper
    from pipeline.types.records import Frame


NOT_TIMED = "not timed: the only scan loads the compiled code"
HELP = "map a run without a browser and write its files"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("source", metavar="SOURCE", type=flags.source, help=flags.SOURCE_HELP)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the files")
    flags.add_force_flag(parser)
    flags.add_parameter_flags(parser)
    flags.add_run_flags(parser)
    flags.add_source_flags(parser)
    flags.add_live_flags(parser)
    parser.add_argument("--truth", metavar="FILE", type=Path, help="ground truth trees (CSV) for the scores")
    flags.add_dbh_unit_flag(parser)
    parser.add_argument(
        "--repairs", metavar="FILE", type=Path, help="repairs of the map that were saved on the page"
    )
    parser.add_argument(
        "--as-live",
        action="store_true",
        help="of a recorded live run: map only the scans that were mapped live, for the same map again",
    )
    parser.add_argument(
        "--stop-after",
        metavar="N",
        type=flags.whole_number(1, (1 << 31) - 1),
        help="map only the first N scans",
    )
    parser.set_defaults(seed=None)
    parser.epilog = (
        "Writes trees.csv, path.csv, trees.geojson, detections.csv, terrain.csv, run.json and state.zip\n"
        "(the state of the map) to DIR, with the same bytes for the same source, parameters and seed. A map\n"
        "of the same source in DIR is replaced. Exit code 3: some messages or points were left out,\n"
        "or the map is doubtful; a line then says since when, why, and what it means for the map."
    )


@flags.compilation_notice()
def run(arguments: argparse.Namespace) -> int:
    """Map a run of scans; print the result.

    Returns:
        Exit code: 3 if messages or points were left out or the map is doubtful, else 0.

    Raises:
        StemmapError: The arguments contradict each other, or the run cannot be mapped.
        OSError: The folder --out cannot be written.
    """
    return map_scans(arguments)


def publish(frame: Frame, mapper: Mapper, live: LiveSource | None) -> None:
    """Publish and record the results of a scan of a live source."""
    if live is not None:
        live.mapped(frame, mapper.path)


def map_scans(arguments: argparse.Namespace, earlier: EarlierRun | None = None) -> int:
    """Map a run of scans and print the result; return the exit code. Arguments and errors as in `map_to`."""
    outcome, replaces = map_to(arguments, earlier)

    from app.batch.map_run import WRONG

    stages = ", ".join(f"{stage} {ms:.2f}" for stage, ms in outcome.stage_ms.items())
    times = f"median {outcome.scan_ms:.2f} ms per scan; stages: {stages}" if outcome.scan_ms else NOT_TIMED
    return print_result(
        [*outcome.summary, times],
        arguments.out,
        outcome.warnings,
        outcome.losses,
        replaces=replaces,
        wrong=WRONG,
    )


def map_to(
    arguments: argparse.Namespace,
    earlier: EarlierRun | None = None,
    on_scan: Callable[[Frame, Mapper, LiveSource | None], None] = publish,
) -> tuple[MappingResult, bool]:
    """Map a run of scans, recorded, simulated or live, to the folder --out. Return the result, and whether
    files of an earlier run were replaced.

    With an earlier run, seed and parameters are those of that run unless flags give others. Without flags for
    parameters, a recorded live run is mapped with the parameters of its recording.

    Args:
        arguments: Arguments of the command.
        earlier: The run whose map this run goes on with; None begins a map.
        on_scan: Called with the results of each scan, the mapper, and the source if it is live.

    Raises:
        StemmapError: The source cannot be read, a flag is wrong or does not fit the source, the start in the
            map was not found, or the folder has the map of another source.
        OSError: The folder cannot be written.
    """
    flags.chosen_parameters(arguments, "forest")  # reports a mistyped flag before heavy modules are loaded

    from app.batch.map_run import OfflineRun, map_run
    from app.batch.run_folder import check_folder, partial_output_warnings
    from app.robot.source import LiveSource, open_any
    from app.worker.numba_warmup import compile_ahead
    from app.worker.run import recorded_parameters
    from pipeline.io.ground_truth import read_truth_trees
    from pipeline.repairs.record import read_repairs

    flags.print_warnings(partial_output_warnings(arguments.out))
    flags.refuse_one_step(arguments)
    truth_trees = read_truth_trees(arguments.truth, dbh_unit=arguments.dbh_unit) if arguments.truth else None
    repairs = read_repairs(arguments.repairs) if arguments.repairs else ()
    saved = None if earlier is None else earlier.saved
    if arguments.seed is None:
        arguments.seed = saved.seed if saved else 0
    request = flags.source_request(arguments, arguments.source)
    chosen = request.kept_choices()
    if arguments.as_live:
        chosen = {**(chosen or {}), "as_live": True}
    options = replace(request.options(), as_live=arguments.as_live)
    recording = flags.recording_place(arguments, arguments.source)
    with (
        closing(open_any(arguments.source, options)) as opened,
        _listening(opened, recording, publish=arguments.publish),
    ):
        revisions = (
            () if saved or flags.says_parameters(arguments) else recorded_parameters(opened.description)
        )
        preset_name, parameters = flags.chosen_parameters(
            arguments,
            saved.preset if saved else opened.description.preset,
            saved.chosen_parameters() if saved else revisions[0][1] if revisions else None,
        )
        live = opened if isinstance(opened, LiveSource) else None
        if live is not None:
            live.use_parameters(0, 0, parameters)
        compile_ahead()
        first = saved.sources[0].digest if saved else opened.description.digest
        replaces = check_folder(arguments.out, first, force=arguments.force)
        with flags.scan_progress(opened.description.scans, "mapping") as bar:

            def mapped(frame: Frame, mapper: Mapper) -> None:
                on_scan(frame, mapper, live)
                bar.update(1)

            plan = OfflineRun(
                source=opened,
                preset=preset_name,
                parameters=parameters,
                seed=arguments.seed,
                odometry=arguments.odometry,
                truth_trees=truth_trees,
                earlier=earlier,
                stop_after=arguments.stop_after,
                revisions=revisions,
                on_frame=mapped,
                chosen=chosen,
                repairs=repairs,
            )
            outcome = map_run(plan, arguments.out)
    return outcome, replaces


def print_result(
    summary: list[str],
    out: Path,
    warnings: list[str],
    losses: dict[str, int],
    *,
    replaces: bool,
    wrong: tuple[str, ...] = (),
) -> int:
    """Print the result of a mapping command; return the exit code, see `summary.exit_code`.

    Args:
        summary: Lines to print.
        out: Folder of the files.
        warnings: Messages to print on stderr.
        losses: Number of messages that were left out, by reason.
        replaces: Whether the folder had the files of an earlier run.
        wrong: First words of warnings after which the map is not as it should be.
    """
    from app.batch.summary import exit_code

    for line in summary:
        print(line)
    print(f"files in {out}" + (" (replaced)" if replaces else ""))
    flags.print_warnings(warnings)
    for reason, number in losses.items():
        print(f"left out: {reason} ({number:,})", file=sys.stderr)
    return exit_code(warnings, losses, wrong)


# --- live sources ------------------------------------------------------------------------------------

_NOTICE_S = 5.0


@contextmanager
def _listening(source: Source | LiveSource, recording: str, *, publish: bool) -> Iterator[None]:
    """Wait until a live source sends scans. Inside, Ctrl-C and SIGTERM end its records and not the command.
    Other sources are ready at once and keep both signals.

    Args:
        source: Live or not.
        recording: File to which the messages are recorded; "" for none.
        publish: Whether results are published on the network of the robot.

    Raises:
        SourceError: It was stopped before a scan arrived, a message cannot be read, or no recording can be
            created.
    """
    from app.robot.recorder import Recorder
    from app.robot.source import LiveSource
    from app.worker.numba_warmup import warm_up

    if not isinstance(source, LiveSource):
        yield
        return
    source.keep_pictures()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *_: source.stop()) for number in numbers}
    try:
        source.start(Recorder(Path(recording)) if recording else None, publish=publish)
        warm_up()
        with _notices(source):
            if not source.wait():
                raise SourceError("nothing was heard", where=source.uri, remedy=source.waiting_for())
            print(
                f"{source.uri} is heard; Ctrl-C ends the run and writes its files",
                file=sys.stderr,
                flush=True,
            )
            yield
    finally:
        if source.recording:
            print(f"stemmap: {source.recording}", file=sys.stderr, flush=True)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _notices(source: LiveSource) -> Iterator[None]:
    """Print the notices of a live source and the reason why no scans arrive to standard error, every five
    seconds while the context is active, in a thread; notices that are left are printed at its end."""
    ended = threading.Event()

    def show(*lines: str) -> None:
        for line in filter(None, lines):
            print(f"stemmap: {line}", file=sys.stderr, flush=True)

    def watch() -> None:
        while not ended.wait(_NOTICE_S):
            show(*source.notices(), source.waiting_for())

    thread = threading.Thread(target=watch, name="notices", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        show(*source.notices())
