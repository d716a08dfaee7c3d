"""`stemmap map`: the whole mapping without a browser, as fast as it can."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from pathlib import Path

from app.cli.choices import SOURCE_HELP, add_parameter_flags, add_run_flags, chosen_parameters, source
from pipeline.errors import StemmapError

HELP = "map a run without a browser and write its files"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument("source", metavar="SOURCE", type=source, help=SOURCE_HELP)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the files")
    add_parameter_flags(parser)
    add_run_flags(parser)
    parser.add_argument(
        "--truth", metavar="FILE", type=Path, help="ground truth trees (CSV), to be judged by"
    )
    parser.add_argument(
        "--dbh-unit", choices=("m", "cm", "mm"), help="of a truth column that does not say it"
    )
    parser.epilog = (
        "DIR gets trees.csv, path.csv, trees.geojson, detections.csv, run.json (all the same bytes for the\n"
        "same source, parameters and seed). Exit code 3 says that something was left out."
    )


def run(arguments: argparse.Namespace) -> int:
    """Map the run."""
    from app.offline import OfflineRun, map_run
    from pipeline.sources import SourceOptions, open_source
    from pipeline.truth_table import read_truth_trees

    truth_trees = read_truth_trees(arguments.truth, dbh_unit=arguments.dbh_unit) if arguments.truth else None
    with closing(open_source(arguments.source, SourceOptions(seed=arguments.seed))) as source:
        preset_name, parameters = chosen_parameters(arguments, source.description.preset)
        plan = OfflineRun(
            source=source,
            preset=preset_name,
            parameters=parameters,
            seed=arguments.seed,
            odometry=arguments.odometry,
            truth_trees=truth_trees,
        )
        try:
            outcome = map_run(plan, arguments.out, progress=_Bar(source.description.scans))
        except OSError as error:
            raise StemmapError(
                f"cannot write: {error.strerror}", where=str(error.filename or arguments.out)
            ) from None
    for line in outcome.summary:
        print(line)
    stages = ", ".join(f"{stage} {ms:.2f}" for stage, ms in outcome.stage_ms.items())
    print(f"median {outcome.scan_ms:.2f} ms a scan ({stages})")
    print(f"files in {arguments.out}")
    for warning in outcome.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for reason, number in outcome.losses.items():
        print(f"left out: {number} {reason}", file=sys.stderr)
    return 3 if outcome.losses else 0


class _Bar:
    """A progress bar on a terminal, nothing elsewhere. Until the first scan is done it says what a
    first run on a machine waits for."""

    def __init__(self, scans: int | None) -> None:
        from tqdm import tqdm

        self._bar = tqdm(
            total=scans,
            unit="scan",
            desc="preparing (the first run on a machine compiles for half a minute)",
            file=sys.stderr,
            disable=not sys.stderr.isatty(),
            leave=False,
        )
        self._begun = False

    def update(self, n: int = 1, /) -> object:
        """So many scans more."""
        if not self._begun:
            self._bar.set_description("mapping", refresh=False)
            self._begun = True
        return self._bar.update(n)

    def close(self) -> None:
        """No more will come."""
        self._bar.close()
