"""`stemmap [serve] [SOURCE]`: the dashboard."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from app.cli import flags
from app.common.settings import DEFAULT_PORT, VARIABLES
from pipeline.errors import UsageError

if TYPE_CHECKING:
    from app.common.settings import Settings
    from app.dashboard.parameters import ParameterState
    from app.worker.protocol import Open

HELP = "open the dashboard in a browser"

_DEFAULT_SOURCE = "sim:stand"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        type=flags.source,
        nargs="*",
        help=f"{flags.SOURCE_HELP} (default: {_DEFAULT_SOURCE}); several ones get one "
        "dashboard each and a common page",
    )
    parser.add_argument(
        "--port",
        type=flags.whole_number(0, 65535),
        metavar="N",
        help=f"port to listen on, 0 for any free one (default: {DEFAULT_PORT}, or one of the next)",
    )
    parser.add_argument(
        "--host",
        metavar="ADDRESS",
        help="address to listen on (default: this machine only; other addresses are open to the network)",
    )
    flags.add_parameter_flags(parser)
    flags.add_run_flags(parser)
    flags.add_source_flags(parser)
    flags.add_live_flags(parser)
    parser.add_argument("--viewer", action="store_true", help="also print a view-only link")
    parser.add_argument("--no-browser", action="store_true", help="print the link without opening a browser")
    width = max(map(len, VARIABLES))
    table = "\n".join(
        textwrap.fill(meaning, 110, initial_indent=f"  {name:{width}}  ", subsequent_indent=" " * (width + 4))
        for name, meaning in VARIABLES.items()
    )
    parser.epilog = f"Settings in the environment (flags win):\n{table}"


def run(arguments: argparse.Namespace) -> int:
    """Serve until Ctrl-C; return the exit code.

    Raises:
        StemmapError: An argument is wrong, a source does not exist, there are several, or the port cannot be
            used.
    """
    settings, sources, make_parameters = requested(arguments)
    if len(sources) > 1:
        raise UsageError(
            f"{len(sources)} sources are named, and a dashboard shows one",
            remedy="Name one source; `stemmap extensions` shows what is switched off",
        )
    from app.web.serving import serve

    return serve(settings, source=sources[0], parameter_state=make_parameters())


def requested(
    arguments: argparse.Namespace,
) -> tuple[Settings, list[Open], Callable[[], ParameterState]]:
    """Return the settings, the sources, and a function that returns the initial parameters of a dashboard.

    Raises:
        StemmapError: An argument is wrong, or a source does not exist.
    """
    from msgspec.structs import asdict

    from app.common.settings import from_environment
    from app.sources.opening import check_address

    settings = replace(
        from_environment(), opens_browser=not arguments.no_browser, prints_viewer_link=arguments.viewer
    )
    if arguments.host is not None:
        settings = replace(settings, host=arguments.host)
    if arguments.port is not None:
        settings = replace(settings, port=arguments.port)
    uris = arguments.source or [_DEFAULT_SOURCE]
    for uri in uris:
        check_address(uri)
    record = flags.recording_place(arguments, *uris)
    flags.chosen_parameters(arguments, "forest")  # reports a mistyped flag here and not on the page

    from app.dashboard.parameters import ParameterState
    from app.worker.protocol import Open

    requests = [flags.source_request(arguments, uri) for uri in uris]
    sources = [Open(**asdict(each), record=record, publish=arguments.publish) for each in requests]
    return (
        settings,
        sources,
        lambda: ParameterState(lambda suggested: flags.chosen_parameters(arguments, suggested)),
    )
