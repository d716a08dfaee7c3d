"""`stemmap map FOLDER_OF_RUNS`: maps each run in a folder, in processes on this machine or on a cluster."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from app.cli import flags
from app.extensions.cluster import dask_flag
from pipeline.errors import ParameterError

if TYPE_CHECKING:
    from app.common.task_pool import TaskPool
    from app.extensions.cluster.many_runs import MappedFiles

FAILED, LEFT_OUT = 1, 3
_FILES = ("--truth", "--config", "--repairs")  # flags whose value is a file


def configure(parser: argparse.ArgumentParser) -> None:
    """Add --jobs and --dask."""
    group = parser.add_argument_group(
        "many runs", "SOURCE may be a folder of runs; each is mapped to a folder in DIR, see runs.csv there"
    )
    group.add_argument(
        "--jobs",
        metavar="N",
        type=flags.whole_number(1, 1024),
        help="runs that are mapped at the same time on this machine (default: one per core)",
    )
    dask_flag.configure(parser)


def check(arguments: argparse.Namespace) -> None:
    """Set the pool of the command; refuse flags of many runs for a single one.

    Raises:
        ParameterError: --jobs or --dask is given for a source that is no folder of runs.
        StemmapError: The extra `dask` is not installed.
    """
    if (arguments.jobs or arguments.dask) and not _runs_in(arguments.source):
        raise ParameterError(
            "--jobs and --dask are for a folder of several runs", where=arguments.source, remedy="Remove them"
        )
    dask_flag.check(arguments)


def run(arguments: argparse.Namespace) -> int | None:
    """Map all runs of a folder and print a line for each; None if the source is no folder of runs.

    Returns:
        Exit code: 0; 3 if messages, points or runs were left out; 1 if no run could be mapped.

    Raises:
        StemmapError: A flag is wrong, the cluster cannot be used, or a file cannot be written.
    """
    names = _runs_in(arguments.source)
    if not names:
        return None
    flags.chosen_parameters(arguments, "forest")  # reports a mistyped flag before a process is started

    from pipeline.io.readers import path_of

    if Path(path_of(arguments.source)).expanduser().resolve() == arguments.out.resolve():
        raise ParameterError(
            "the maps would be written among the recordings", where=str(arguments.out), remedy="Name another"
        )
    from app.common.child_process import usable_cores
    from app.extensions.cluster.many_runs import TABLE, LocalPool, end_processes, map_runs

    pool: TaskPool = arguments.pool or LocalPool(min(arguments.jobs or usable_cores(), len(names)))
    others = _other_words(arguments)
    tasks = {
        folder: [str(Path(path_of(arguments.source)).expanduser().absolute() / name), *others]
        for name, folder in zip(names, _folder_names(names), strict=True)
    }
    try:
        with flags.progress_bar(len(tasks), "run", "mapping") as bar:

            def done(name: str, result: MappedFiles) -> None:
                bar.write(f"{name}: {_words_of(result)}", file=sys.stdout)
                bar.update(1)

            codes = map_runs(tasks, arguments.out, pool, done, force=arguments.force)
        flags.print_warnings(pool.warnings())
    finally:
        pool.close(end_processes)
    print(f"{TABLE} and the folders of the runs in {arguments.out}")
    if all(code not in (0, LEFT_OUT) for code in codes):
        return FAILED
    return LEFT_OUT if any(codes) else 0


def _runs_in(source: str) -> list[str]:
    """Return the names of the runs in a folder, without those of a slash at their end; [] if the source is a
    run itself, is no folder, or has one run, which is mapped as the source."""
    import app.sources  # noqa: F401 - adds the formats of the extensions
    from pipeline.io.readers import folder_opener, path_of, runs_in

    try:
        folder = Path(path_of(source)).expanduser()
        if not folder.is_dir() or folder_opener(folder) is not None:
            return []
        names = [name.rstrip("/") for name in runs_in(folder)]
    except (OSError, RuntimeError, ValueError):
        return []
    return sorted(names) if len(names) > 1 else []


def _folder_names(names: Sequence[str]) -> list[str]:
    """Return a name of a folder for each run: its name without suffix, or as it is where two would be
    equal."""
    stems = [Path(name).stem for name in names]
    return [
        stem if stems.count(stem) == 1 and stem not in names else name
        for name, stem in zip(names, stems, strict=True)
    ]


def _other_words(arguments: argparse.Namespace) -> list[str]:
    """Return the words of the command line that hold for each run: without the command, the source, --out,
    --force, --jobs and --dask."""
    own = argparse.ArgumentParser(add_help=False)
    for flag in ("--out", "--jobs", "--dask"):
        own.add_argument(flag)
    own.add_argument("--force", action="store_true")
    words = own.parse_known_args(list(arguments.words[1:]))[1]
    del words[_place_of_source(words, arguments.source)]
    for k, word in enumerate(words):  # a worker has another current folder
        flag, equals, value = word.partition("=")
        if flag in _FILES and equals:
            words[k] = f"{flag}={Path(value).absolute()}"
        elif k and words[k - 1] in _FILES:
            words[k] = str(Path(word).absolute())
    return words


def _place_of_source(words: Sequence[str], source: str) -> int:
    """Return the index of the source among words: of equal ones, the last that follows no flag, else the last
    one."""
    places = [k for k, word in enumerate(words) if word == source]
    return next((k for k in reversed(places) if k == 0 or not words[k - 1].startswith("--")), places[-1])


def _words_of(result: MappedFiles) -> str:
    """Return the result of a run in a line."""
    import json

    if not result.files:
        return f"failed: {flags.plain(' '.join(result.messages).removeprefix('stemmap: '))}"
    record = json.loads(result.files["run.json"])
    text = f"{record['trees']} trees, {record['scans']} scans"
    return f"{text}; {flags.plain(result.messages[0])}" if result.code and result.messages else text
