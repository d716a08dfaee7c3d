"""Runs benchmarks by name and writes their results."""

from __future__ import annotations

import importlib
import json
import pkgutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path

from pipeline.errors import StemmapError, UsageError
from pipeline.io.atomic_files import write_beside
from tests.benchmarks import cases
from tests.benchmarks.machine import description
from tests.benchmarks.process import tables_of
from tests.benchmarks.table import Table

HEADING = """# Benchmarks

Written by `python -m tests.benchmarks`; do not edit. Both sides of a comparison are measured in turns (A B A
B), each library at one thread, because machines are noisy: ratios hold, absolute times vary up to twofold.
"""


def descriptions() -> dict[str, str]:
    """Return the name and the one-line description of every benchmark."""
    names = sorted(module.name for module in pkgutil.iter_modules(cases.__path__))
    modules = [importlib.import_module(f"tests.benchmarks.cases.{name}") for name in names]
    return {module.NAME: module.LINE for module in modules}


def run(names: Sequence[str], *, out: Path, json_file: Path | None, day: date) -> list[str]:
    """Run benchmarks one after the other, write the files, and return the names of those that failed.

    Args:
        names: None given means all.
        out: Markdown; sections of benchmarks that were not run, or failed, are kept.
        json_file: The figures of this run alone.
        day: Date that is written with the figures.

    Raises:
        StemmapError: There is no such benchmark or folder.
    """
    known = descriptions()
    unknown = [name for name in names if name not in known]
    if unknown:
        raise UsageError(f"there is no benchmark {unknown[0]!r}", remedy=f"Benchmarks: {', '.join(known)}")
    for path in (out, json_file):
        if path is not None and not path.parent.is_dir():
            raise StemmapError("there is no such folder to write to", where=str(path.parent))
    machine = description()
    done: dict[str, list[Table]] = {}
    failed: list[str] = []
    for name in [name for name in known if name in names or not names]:
        print(f"{name}: {known[name]} ...", file=sys.stderr, flush=True)
        try:
            done[name] = tables_of(name)
        except StemmapError as error:
            print(f"stemmap: {error}", file=sys.stderr)
            failed.append(name)
            continue
        print("\n\n".join(table.markdown() for table in done[name]) + "\n", flush=True)
        _write(out, {name: section(name, known[name], done[name], machine, day)}, list(known))
    if json_file is not None:
        with write_beside(json_file) as partial:
            partial.write_text(as_json(done, machine, day), encoding="utf-8")
    return failed


def section(name: str, line: str, tables: Sequence[Table], machine: str, day: date) -> str:
    """The part of the Markdown file that belongs to one benchmark."""
    body = "\n\n".join(table.markdown() for table in tables)
    return f"## {name}\n\n{line}. `python -m tests.benchmarks {name}`, {day}, {machine}.\n\n{body}\n"


def as_json(done: Mapping[str, Sequence[Table]], machine: str, day: date) -> str:
    """The figures for programs."""
    benchmarks = {name: [asdict(table) for table in tables] for name, tables in done.items()}
    return json.dumps({"date": str(day), "machine": machine, "benchmarks": benchmarks}, indent=1) + "\n"


def merged(text: str, new: Mapping[str, str], order: Sequence[str]) -> str:
    """The file with new sections in the place of old ones of the same name."""
    kept = {part.partition("\n")[0].strip(): f"## {part.rstrip()}\n" for part in text.split("\n## ")[1:]}
    kept = {**kept, **new}
    return "\n".join([HEADING, *(kept[name] for name in order if name in kept)])


def _write(out: Path, new: Mapping[str, str], order: Sequence[str]) -> None:
    text = out.read_text(encoding="utf-8") if out.is_file() else ""
    with write_beside(out) as partial:
        partial.write_text(merged(text, new, order), encoding="utf-8")
