"""Extensions: what they register, and how they are found.

An installed package names its extensions as entry points of the group `stemmap.extensions`; the name of the
entry point is the name of the extension, and its value is an `Extension`. docs/extensions.md shows a complete
one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import StemmapError

if TYPE_CHECKING:
    from fastapi import FastAPI

    from pipeline.io.readers import AnyFormat

GROUP = "stemmap.extensions"
VARIABLE = "STEMMAP_EXTENSIONS"
#: Where the pages of extensions are, below /static/.
EXTENSION_PAGES = "js/extensions"


@dataclass(frozen=True, slots=True, kw_only=True)
class Extension:
    """What an extension adds to the program. Its module is imported at each start, so heavy modules are
    imported only inside of functions.

    Attributes:
        help: What it adds, in one line.
        commands: Dotted module by the name of a command. The module has `HELP`, `configure(parser)` and
            `run(arguments)`, which returns the exit code.
        takes: Dotted module by the name of a command. The module has `configure(parser)`, which adds flags,
            and `run(arguments)`, which returns the exit code, or None if the command shall do the work. If it
            has `check(arguments)`, that is called before any `run`; it may refuse them, and set
            `arguments.pool`, the `app.common.task_pool.TaskPool` in which the command computes its tasks.
            The words of the command line are `arguments.words`.
        web: Adds routes to the application of a dashboard (`app.state.dashboard`, `app.state.settings`),
            which are tried before those of the program; coroutine functions in the list `app.state.closing`
            are called at its end.
        page: Folder of JavaScript whose main.js registers parts of the dashboard, and runs.js parts of the
            page of runs (static/js/shell/extensions.js), with main.css and runs.css; each may be missing.
        formats: Returns formats of files and folders and their readers, which are tried after those of the
            program (folders before), of messages of LiDARs, and of readings in another frame. If the
            extension is switched off, they are refused.
        addresses: Dotted module by the scheme of the addresses of live sources. The module has `parse(uri)`,
            which returns an `app.sources.live_address.Address`, and `connect(address, inbox)`, which
            returns an `app.robot.link.Link`.
        sources: Dotted module of sources that are mapped in one step instead of scan by scan. The module has
            `WHAT`, their name for people, `takes(uri, options)`, which returns whether a source is one of
            them, `check(uri, options)`, which raises SourceError for one that cannot be opened, and
            `open_source(uri, options)`, which returns an `app.sources.one_step.OneStepSource`. `takes` and
            `check` are called in the web process. If the extension is switched off, its sources are refused.
    """

    help: str
    commands: Mapping[str, str] = field(default_factory=dict)
    takes: Mapping[str, str] = field(default_factory=dict)
    web: Callable[[FastAPI], None] | None = None
    page: Path | None = None
    formats: Callable[[], Iterable[AnyFormat]] | None = None
    addresses: Mapping[str, str] = field(default_factory=dict)
    sources: str = ""


@dataclass(frozen=True, slots=True)
class Found:
    """An extension of an installed package.

    Attributes:
        name: Name of its entry point.
        package: Name and version of the package.
        extension: What it adds; None if it could not be loaded.
        problem: Why it could not be loaded; "" if it was.
        is_on: Whether the user wants it.
    """

    name: str
    package: str
    extension: Extension | None
    problem: str
    is_on: bool


def extensions_on() -> dict[str, Extension]:
    """Return the extensions that are loaded and switched on, by name in alphabetical order."""
    return {
        each.name: each.extension for each in all_extensions() if each.is_on and each.extension is not None
    }


def all_extensions() -> tuple[Found, ...]:
    """Return all extensions of the installed packages, in the order of their names; also those that are
    switched off, and those that could not be loaded."""
    wanted = wanted_names()
    return tuple(
        Found(name, package, extension, problem, wanted is None or name in wanted)
        for name, package, extension, problem in _loaded()
    )


def wanted_names() -> frozenset[str] | None:
    """Return the names in the variable STEMMAP_EXTENSIONS, which are separated by commas; None, for all
    extensions, if it is not set."""
    given = os.environ.get(VARIABLE)
    return None if given is None else frozenset(name for word in given.split(",") if (name := word.strip()))


def problems() -> Iterator[str]:
    """Yield one line for each extension that is wanted and cannot be used, and for each wanted name that is
    unknown."""
    found = all_extensions()
    for each in found:
        if each.is_on and each.problem:
            yield f"the extension {each.name} of {each.package} is left out: {each.problem}"
    for name in sorted((wanted_names() or frozenset()) - {each.name for each in found}):
        known = ", ".join(each.name for each in found) or "none"
        yield f"there is no extension {name!r}, which {VARIABLE} names; known: {known}"


def switched_off(extension: str) -> str:
    """Return the remedy of an error whose reason is that an extension is switched off."""
    return f"The extension {extension} is switched off by {VARIABLE}."


@cache
def static_folder() -> Path:
    """Return the folder of index.html: `app/static` of an installed package, or `static/` of a checkout.

    Raises:
        StemmapError: Neither folder exists.
    """
    package = Path(str(files("app")))
    for folder in (package / "static", package.parent / "static"):
        if (folder / "index.html").is_file():
            return folder
    raise StemmapError("the page is missing", where=str(package / "static"), remedy="Install stemmap again")


def page_folder(extension: str) -> Path:
    """Return the folder of JavaScript of an extension of this package."""
    return static_folder() / EXTENSION_PAGES / extension


@cache
def _loaded() -> tuple[tuple[str, str, Extension | None, str], ...]:
    """Return name, package, record and problem of each entry point."""
    rows: list[tuple[str, str, Extension | None, str]] = []
    for entry in sorted(entry_points(group=GROUP), key=lambda each: each.name):
        package = "an unknown package" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
        if rows and rows[-1][0] == entry.name:
            rows.append((entry.name, package, None, f"{rows[-1][1]} has an extension of the same name"))
        else:
            rows.append((entry.name, package, *_load(entry)))
    return tuple(rows)


def _load(entry: EntryPoint) -> tuple[Extension | None, str]:
    """Return the record of an entry point, or None and the reason."""
    try:
        extension = entry.load()
    except (Exception, SystemExit) as error:  # the code of others must not end the program
        return None, f"{type(error).__name__}: {error}"
    if not isinstance(extension, Extension):
        return None, f"{entry.value} is no app.extension.Extension"
    return extension, ""
