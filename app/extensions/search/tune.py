"""`stemmap tune`: searches the parameters that give the best map of runs with true trees."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli import flags
from app.extensions.search.run_flags import add_keep_flag, kept_results, planned_run
from pipeline.errors import ParameterError, StemmapError

if TYPE_CHECKING:
    from app.extensions.search.plan import Plan, PlannedRun, Trial
    from app.extensions.search.search import Search

HELP = "search the parameters that give the best map of runs with true trees"
STOPPED = 3


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "runs", metavar="RUN", nargs="+", type=flags.source, help="recordings, folders, clouds or sim:"
    )
    flags.add_truth_flags(parser)
    parser.add_argument(
        "--held-out",
        metavar="RUN",
        type=flags.source,
        action="append",
        default=[],
        help="a run that is only scored and does not guide the search; may be repeated",
    )
    parser.add_argument(
        "--over",
        metavar="NAME[=LOW..HIGH|=A,B]",
        action="append",
        default=[],
        help="a parameter of the search, within its declared bounds or narrower ones; may be repeated "
        "(default: eight parameters with a large effect)",
    )
    parser.add_argument(
        "--goal", choices=("f1", "ta", "position", "pairs"), default="f1",
        help="f1: F1 (default); ta: TA with a limit of false trees; position, pairs: position RMSE or "
        "pair error with F1 not below that of the start",
    )  # fmt: skip
    parser.add_argument(
        "--false-max", metavar="SHARE", type=flags.share, default=0.1,
        help="with --goal ta: largest share of false trees in the map (default: 0.1)",
    )  # fmt: skip
    parser.add_argument(
        "--trials",
        metavar="N",
        type=flags.whole_number(1, 1 << 20),
        default=200,
        help="number of trials (default: 200)",
    )
    parser.add_argument(
        "--minutes",
        metavar="M",
        type=flags.positive_number(1e6, "time in minutes"),
        default=0.0,
        help="time limit",
    )
    parser.add_argument(
        "--workers", metavar="N", type=flags.whole_number(1, 1 << 20), default=1,
        help="number of processes; another number gives other trials (default: 1)",
    )  # fmt: skip
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="TOML file for the best set")
    add_keep_flag(parser)
    flags.add_parameter_flags(parser)
    flags.add_run_flags(parser)
    flags.add_source_flags(parser)
    parser.epilog = "Ctrl-C stops the search and writes the best set so far; the same command continues it."


@flags.compilation_notice()
def run(arguments: argparse.Namespace) -> int:
    """Search and write the best set to --out.

    Returns:
        Exit code: 0, or STOPPED if trials are missing (time limit or Ctrl-C).

    Raises:
        StemmapError: An argument is wrong, or a run cannot be read or scored.
        KeyboardInterrupt: Ctrl-C before the first trial; nothing is written.
    """
    from app.extensions.search.search import Search, search_processes
    from app.worker.numba_warmup import compile_ahead

    plan = _plan(arguments)
    compile_ahead()
    with closing(search_processes(plan, arguments.workers, arguments.pool)) as workers:
        search = Search(plan, workers)
        stopped = _search(search)
        flags.print_warnings(workers.warnings())
        return _finish(search, arguments, stopped=stopped)


def _plan(arguments: argparse.Namespace) -> Plan:
    """Return the plan that the arguments give; opens the first run to find its preset.

    Raises:
        StemmapError: A run is live, or named twice, an argument is wrong, the first run or a file of true
            trees cannot be read, or the folder for --out does not exist.
    """
    from app.extensions.search.plan import SENSIBLE, Plan, axes_of
    from app.extensions.search.scoring import open_run
    from app.sources.live_address import is_live

    for uri in (*arguments.runs, *arguments.held_out):
        if is_live(uri):
            raise ParameterError(
                "a live run cannot be mapped again",
                where=uri,
                remedy="Record it, and name the recording",
            )
    runs = _planned(arguments)
    with closing(open_run(runs[0].source)) as first:
        preset_name, parameters = flags.chosen_parameters(arguments, first.preset)
    if not arguments.out.absolute().parent.is_dir():
        raise StemmapError("the folder for --out does not exist", where=str(arguments.out.absolute().parent))
    return Plan(
        runs=runs,
        axes=axes_of(arguments.over or SENSIBLE),
        start=parameters.model_dump(),
        kept=str(kept_results(arguments) or ""),
        preset=preset_name,
        goal=arguments.goal,
        false_max=arguments.false_max,
        seed=arguments.seed,
        odometry=arguments.odometry,
        trials=arguments.trials,
        seconds=60.0 * arguments.minutes,
    )


def _planned(arguments: argparse.Namespace) -> tuple[PlannedRun, ...]:
    """Return the runs of the search, the held-out ones last.

    Raises:
        StemmapError: A run is named twice, or a file of true trees cannot be read or assigned.
    """
    uris = [*arguments.runs, *arguments.held_out]
    files = flags.files_of(uris, arguments.truths)
    for k, uri in enumerate(uris):
        if uri in uris[:k]:
            raise ParameterError("a run is named twice", where=uri, remedy="Name it once")
    return tuple(
        planned_run(arguments, uri, files.get(uri), held_out=k >= len(arguments.runs))
        for k, uri in enumerate(uris)
    )


def _search(search: Search) -> bool:
    """Score the start, make the trials and show progress; return whether the search stopped before the last
    trial, by the time limit, which counts from the score of the start, or Ctrl-C.

    Raises:
        KeyboardInterrupt: Ctrl-C before the first trial.
        StemmapError: A run cannot be mapped or scored.
    """
    import time

    plan, bar = search.plan, _SearchProgress(search.plan)
    since_s = time.monotonic()
    try:
        while search.start is None:
            search.advance()
        bar.begin(search.start)
        since_s = time.monotonic()
        while not search.is_complete and not 0.0 < plan.seconds < time.monotonic() - since_s:
            search.advance()
            bar.show(search)
        return not search.is_complete
    except KeyboardInterrupt:
        if not search.trials() or search.start is None:
            raise
        return True
    finally:
        bar.close(len(search.trials()), time.monotonic() - since_s)


def _finish(search: Search, arguments: argparse.Namespace, *, stopped: bool) -> int:
    """Write the best set to --out, print the result, and print warnings to standard error; return the exit
    code: STOPPED if trials are missing, else 0. StemmapError if the file cannot be written.

    Args:
        search: The search, whose start is scored.
        arguments: Arguments of the command.
        stopped: Whether trials are missing.
    """
    from datetime import date

    from app.common.text import count
    from app.extensions.search.result import lines_of, result_of, toml_of, warning_of
    from pipeline.io.atomic_files import write_beside

    plan, result = search.plan, result_of(search)
    text = toml_of(plan, result, date.today().isoformat())
    with write_beside(arguments.out) as file:
        file.write_text(text, encoding="utf-8")
    for line in lines_of(plan, result):
        print(line)
    print(f"written to {arguments.out}; use it with --config {arguments.out}")
    if warning := warning_of(result):
        print(f"warning: {warning}", file=sys.stderr)
    if stopped:
        left = plan.trials - result.made
        print(f"left out: {count(left, 'trial')}; the same command continues the search", file=sys.stderr)
        return STOPPED
    return 0


class _SearchProgress:
    """A progress bar, and a line for each set that is better than all before."""

    def __init__(self, plan: Plan) -> None:
        self._goal = plan.aim
        self._best: float | None = None
        self._bar = flags.progress_bar(plan.trials, "trial", "first mapping")

    def begin(self, start: Trial) -> None:
        """Print the score of the start."""
        self._line(f"start: {self._goal.shown(start.loss or 0.0)}")
        self._bar.set_description("searching", refresh=False)

    def show(self, search: Search) -> None:
        """Update the bar, and print a line for a new best set."""
        made, best = len(search.trials()), search.best()
        self._bar.update(made - self._bar.n if not self._bar.disable else 0)
        if best is None or best.loss is None or (self._best is not None and best.loss >= self._best):
            return
        self._best = best.loss
        line = f"trial {best.number}: {self._goal.shown(best.loss)}"
        if best.held_out:
            from app.extensions.search.plan import pool

            line += f"   held out: F1 {pool(best.held_out).f1:.3f}"
        self._bar.set_postfix_str(self._goal.shown(best.loss), refresh=False)
        self._line(line)

    def close(self, made: int, seconds: float) -> None:
        """End the bar and, after at least two trials, print their number, the time and the trials per
        hour."""
        self._bar.close()
        if made > 1:
            self._line(f"{made:,} trials in {seconds:,.0f} s: {3600.0 * made / seconds:,.0f} an hour")

    def _line(self, text: str) -> None:
        """Print a line to standard error, above the bar."""
        self._bar.write(text, file=sys.stderr)
        sys.stderr.flush()
