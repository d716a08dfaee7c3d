"""The command line: `stemmap [serve] [SOURCE]`, `stemmap map SOURCE --out DIR`, and more.

Each command is a module of this package with `HELP`, `configure(parser)` and `run(arguments)`. Heavy modules
are imported inside `run`, so that `--help` answers at once.
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import importlib
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import FrameType, ModuleType
from typing import NoReturn

from app.common.text import version
from app.extension import VARIABLE, Extension, all_extensions, extensions_on, problems, switched_off
from pipeline.errors import ParameterError, StemmapError, UsageError

COMMANDS = (
    "serve",
    "map",
    "recover",
    "info",
    "simulate",
    "send",
    "evaluate",
    "export",
    "params",
    "licences",
    "doctor",
    "extensions",
)

FAILED, WRONG_USAGE = 1, 2


def commands() -> dict[str, str]:
    """Return the dotted module of each command: those of this package, then those of the extensions that are
    switched on, which replace none of an earlier one."""
    found = {name: f"app.cli.{name}" for name in COMMANDS}
    for extension in extensions_on().values():
        found = {**extension.commands, **found}
    return {name: found[name] for name in sorted(found, key=lambda each: each not in COMMANDS)}


CODES = (
    "Exit codes: 0 done; 1 failed, with a message; 2 wrong usage, such as a mistyped flag, parameter or\n"
    "scenario; 3 done, but something was left out or the map is doubtful (see stderr)."
)


_NEGATIVE = re.compile(r"-[\d.][^,]*,")

STOPPED = "stopped; no result was written"
_AGAIN_S = 0.001  # until a request to stop that came inside of the compiler is made again


class _Parser(argparse.ArgumentParser):
    """Reports wrong usage in one line, with the command for help."""

    def error(self, message: str) -> None:  # type: ignore[override]
        """Print wrong usage in one line and end with WRONG_USAGE (SystemExit)."""
        self.exit(WRONG_USAGE, f"{self.prog}: {message}. Help: {self.prog} --help\n")


def _keep_bytecode() -> None:
    """Keep the bytecode of this process and its children in the cache folder of the user if Python must not
    write it beside the sources and the libraries came without it: each start would compile 1,300 modules."""
    library = find_spec("numpy")
    if not sys.dont_write_bytecode or sys.pycache_prefix or library is None or library.cached is None:
        return
    if Path(library.cached).exists():
        return
    with contextlib.suppress(RuntimeError):  # there may be no home
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(cache / "stemmap" / "bytecode")
        sys.dont_write_bytecode = False
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def command() -> NoReturn:
    """The program `stemmap`: runs `main` and ends the process with its exit code. It never returns."""
    _keep_bytecode()
    code = main()
    if "zenoh" in sys.modules:
        # Threads of zenoh may abort the process while the interpreter shuts down, after all files are written
        # and closed. The abort would look like a failure.
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; errors are printed to standard error, except unexpected ones, which are raised.

    Without a command, or if the first word is no command, the command is `serve`.

    Args:
        arguments: Words after the program's name; None takes those of this process.

    Returns:
        0 done, 1 failed with a message (also after Ctrl-C; without one if standard output was closed), 2
        wrong usage, 3 done with losses (see stderr).
    """
    parsed = argparse.Namespace()
    try:
        with _stopping():
            _parse(list(sys.argv[1:] if arguments is None else arguments), parsed)
            return _run(parsed)
    except SystemExit as stop:  # argparse has printed its message
        return int(stop.code or 0)
    except (ParameterError, UsageError) as error:
        return _complain(error, WRONG_USAGE)
    except StemmapError as error:
        return _complain(error, FAILED)
    except MemoryError:
        return _complain("this needs more memory than this machine has", FAILED)
    except KeyboardInterrupt:
        return _complain(STOPPED, FAILED)
    except SystemError as error:  # Ctrl-C while compiled code was loaded
        if not isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):
            raise
        return _complain(STOPPED, FAILED)
    except BrokenPipeError:  # `stemmap params | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except OSError as error:  # a full disk, a folder without rights
        place = error.filename or getattr(parsed, "out", None) or ""
        return _complain(
            StemmapError(f"cannot read or write: {error.strerror or error}", where=str(place)), FAILED
        )


def _parse(words: list[str], parsed: argparse.Namespace) -> None:
    """Parse the words of the command line into a namespace. Raises SystemExit or a StemmapError for wrong
    usage."""
    for problem in problems():
        print(f"stemmap: {problem}", file=sys.stderr)
    if not words or (words[0] not in commands() and words[0] not in ("-h", "--help", "--version")):
        words.insert(0, "serve")  # `stemmap run.mcap` is short for `stemmap serve run.mcap`
    # argparse takes a word such as -5,3,10 for a flag.
    for k in range(len(words) - 1, 0, -1):
        if _NEGATIVE.match(words[k]) and words[k - 1].startswith("--") and words[k - 1] != "--":
            words[k - 1 : k + 1] = [f"{words[k - 1]}={words[k]}"]
    parser, known = _build_parser(words[0])
    _check_command(words)
    _, unknown = parser.parse_known_args(words, parsed)
    if unknown:
        _refuse(unknown, parsed.command, known[parsed.command])
    parsed.words = tuple(words)


def _run(parsed: argparse.Namespace) -> int:
    """Run the command, or an extension that takes it over; return the exit code."""
    command = importlib.import_module(commands()[parsed.command])
    for taker in parsed.takers:
        if hasattr(taker, "check"):
            taker.check(parsed)
    for taker in parsed.takers:
        if (code := taker.run(parsed)) is not None:
            return int(code)
    return int(command.run(parsed))


def _refuse(unknown: list[str], command: str, parser: argparse.ArgumentParser) -> None:
    """Report unknown words of a command: a further source or file as such, a flag with the nearest one as
    remedy, or an extension with flags of the command that is switched off.

    Args:
        unknown: The words, at least one.
        command: Name of the command.
        parser: Parser of the command, which knows its flags.

    Raises:
        UsageError: Always.
    """
    taken = [str(action.metavar) for action in parser._actions if not action.option_strings]
    if taken and not unknown[0].startswith("-"):
        again = f"Call it again for {unknown[0]}. " if len(taken) == 1 else ""
        raise UsageError(
            f"stemmap {command} takes one {' and one '.join(taken)}, and {unknown[0]} is one more",
            remedy=f"{again}See stemmap {command} --help",
        )
    flags = [flag for action in parser._actions for flag in action.option_strings]
    near = difflib.get_close_matches(unknown[0].split("=")[0], flags, n=1, cutoff=0.6)
    off = [
        each.name
        for each in all_extensions()
        if not each.is_on and each.extension is not None and _adds(each.extension, command, unknown[0])
    ]
    hint = f"{switched_off(off[0])} " if off else f"Did you mean {near[0]}? " if near else ""
    raise UsageError(
        f"stemmap {command} does not know {' '.join(unknown)}", remedy=f"{hint}See stemmap {command} --help"
    )


def _adds(extension: Extension, command: str, word: str) -> bool:
    """Return whether an extension adds a flag, the beginning of `word`, to a command of the program."""
    if command not in extension.takes:
        return False
    parser = argparse.ArgumentParser(add_help=False)
    importlib.import_module(extension.takes[command]).configure(parser)
    return any(word.split("=")[0] in action.option_strings for action in parser._actions)


def _check_command(words: list[str]) -> None:
    """Report a mistyped command, such as `stemmap mpa run.mcap`, and a command of an extension that is
    switched off as such and not as a missing file. Words with a colon are addresses and not checked.

    Args:
        words: Words of the command line after `main` has inserted `serve`.

    Raises:
        UsageError: The first word is no command and no existing file, but similar to a command, or a command
            of an extension that is switched off.
    """
    if len(words) < 2 or words[0] != "serve" or words[1].startswith("-") or ":" in words[1]:
        return  # a flag, or an address such as sim:stand
    if words[1] in commands() or os.path.lexists(words[1]):
        return
    for each in all_extensions():
        if not each.is_on and each.extension is not None and words[1] in each.extension.commands:
            raise UsageError(f"there is no command {words[1]!r}", remedy=switched_off(each.name))
    if near := difflib.get_close_matches(words[1], commands(), n=1, cutoff=0.6):
        raise UsageError(f"there is no command {words[1]!r}", remedy=f"Did you mean `stemmap {near[0]}`?")


@contextlib.contextmanager
def _stopping() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM raise KeyboardInterrupt inside the context, so that partial outputs are removed.
    Outside of the main thread nothing changes, and Ctrl-C stays ignored where it was."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        numbers.append(signal.SIGINT)
    again: list[threading.Timer] = []

    def stop(number: int, frame: FrameType | None) -> None:
        if not _is_in_compiler(frame):
            raise KeyboardInterrupt
        # A signal, which also wakes a call that waits.
        again.append(threading.Timer(_AGAIN_S, signal.pthread_kill, (threading.get_ident(), number)))
        again[-1].start()

    before = {number: signal.signal(number, stop) for number in numbers}
    try:
        yield
    finally:
        for timer in again:  # none acts after the handlers are those of before
            timer.cancel()
            timer.join()
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_in_compiler(frame: FrameType | None) -> bool:
    """Return whether a frame was called from the compiler. Python prints an exception that is raised in a
    call from its C code and goes on, and an object that was not completed fails when it is deleted."""
    while frame is not None and not str(frame.f_globals.get("__name__")).startswith("llvmlite.binding"):
        frame = frame.f_back
    return frame is not None


def _build_parser(wanted: str) -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """Return the parser of the program, and the parser of each command by name.

    Args:
        wanted: Command whose arguments are added; the others have only their help text.
    """
    parser = _Parser(
        prog="stemmap",
        description="Maps trees from a robot's LiDAR as it drives, and shows the reasons in the browser.",
        epilog="`stemmap [SOURCE]` opens the dashboard; without a SOURCE a simulated stand plays.\n"
        f"{CODES} Each command has its own --help.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"stemmap {version()}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, dotted in commands().items():
        try:
            module = importlib.import_module(dotted)
        except Exception as error:  # the code of an extension
            if name in COMMANDS:
                raise
            _complain(f"the command {name} is left out: {type(error).__name__}: {error}", FAILED)
            continue
        subparser = subparsers.add_parser(
            name,
            help=module.HELP,
            description=module.HELP,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if name == wanted:
            module.configure(subparser)
            takers = tuple(_takers(name))
            for taker in takers:
                taker.configure(subparser)
            subparser.set_defaults(takers=takers, pool=None)
    return parser, dict(subparsers.choices)


def _takers(command: str) -> Iterator[ModuleType]:
    """Yield the modules of extensions that may take over a command of the program. One that cannot be
    imported is left out, with a message."""
    for name, extension in extensions_on().items():
        if command not in extension.takes:
            continue
        try:
            module = importlib.import_module(extension.takes[command])
        except Exception as error:  # the code of an extension
            _complain(f"the extension {name} is left out of {command}: {error}", FAILED)
            continue
        yield module


def _complain(error: object, code: int) -> int:
    """Print an error to standard error and return the exit code. Unless the error names it, a second line
    names the extensions that are switched off, whose formats and flags the program does not know."""
    print(f"stemmap: {error}", file=sys.stderr)
    off = [each.name for each in all_extensions() if not each.is_on]
    if off and VARIABLE not in str(error):
        print(f"stemmap: {VARIABLE} switches off {', '.join(off)}", file=sys.stderr)
    return code
