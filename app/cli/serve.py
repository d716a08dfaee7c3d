"""`stemmap [serve] [SOURCE]`: the dashboard."""

from __future__ import annotations

import argparse
import textwrap
from dataclasses import replace
from typing import TYPE_CHECKING

from app.cli import flags
from app.common.settings import DEFAULT_PORT, VARIABLES

if TYPE_CHECKING:
    from app.robot.address import ZenohAddress
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
        help=f"{flags.SOURCE_HELP} (default: {_DEFAULT_SOURCE}); several sources, or a router with several "
        "robots, get one dashboard each and a common page",
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
    """Serve until Ctrl-C; return the exit code. Several sources, or a router with several robots, are served
    as a fleet.

    Raises:
        StemmapError: An argument is wrong, a source does not exist, or the port cannot be used.
    """
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
    from app.web.serving import serve
    from app.worker.protocol import Open

    sources = [
        Open(uri, arguments.odometry, arguments.seed, record=record, publish=arguments.publish)
        for uri in uris
    ]

    def make_parameters() -> ParameterState:
        return ParameterState(lambda suggested: flags.chosen_parameters(arguments, suggested))

    watched = _watched(sources)
    if watched is not None or len(sources) > 1:
        from app.fleet import named, serve_fleet

        return serve_fleet(
            settings,
            sources={} if watched is not None else named(sources),
            make_parameters=make_parameters,
            watched=watched,
        )
    return serve(settings, source=sources[0], parameter_state=make_parameters())


def _watched(sources: list[Open]) -> tuple[ZenohAddress, Open] | None:
    """Return the router whose robots are all shown and how they are opened, if the only source is a Zenoh
    address with robot=*, or one that names neither a robot nor topics and several robots are found; else
    None. To find them the router is asked, which takes up to 3 s."""
    from app.robot.address import ALL_ROBOTS, ZenohAddress, is_live, parse_address

    if len(sources) != 1 or not is_live(sources[0].uri):
        return None
    address = parse_address(sources[0].uri)
    if not isinstance(address, ZenohAddress) or address.robot not in ("", ALL_ROBOTS):
        return None
    if address.robot == ALL_ROBOTS:
        return replace(address, robot=""), sources[0]
    if address.topics:  # a topic belongs to one robot
        return None
    from app.fleet import robots_at

    return (address, sources[0]) if len(robots_at(address)) > 1 else None
