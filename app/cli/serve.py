"""`stemmap [serve] [SOURCE]`: the dashboard."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from app.cli.choices import (
    SOURCE_HELP,
    add_live_flags,
    add_parameter_flags,
    add_run_flags,
    chosen_parameters,
    recording_place,
    source,
)
from app.settings import DEFAULT_PORT, VARIABLES, from_environment
from pipeline.errors import SourceError

HELP = "open the dashboard in a browser"

_DEFAULT_SOURCE = "sim:stand"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        type=source,
        nargs="?",
        default=_DEFAULT_SOURCE,
        help=f"{SOURCE_HELP} (default: {_DEFAULT_SOURCE})",
    )
    parser.add_argument(
        "--port",
        type=_port,
        metavar="N",
        help=f"port to listen on, 0 for any free one (default: {DEFAULT_PORT}, or one of the next)",
    )
    parser.add_argument(
        "--host",
        metavar="ADDRESS",
        help="address to listen on (default: this machine only; any other is open to the network)",
    )
    add_parameter_flags(parser)
    add_run_flags(parser)
    add_live_flags(parser)
    parser.add_argument(
        "--viewer", action="store_true", help="print a second link too, for who may look and not touch"
    )
    parser.add_argument("--no-browser", action="store_true", help="print the link, open no browser")
    width = max(map(len, VARIABLES))
    table = "\n".join(f"  {name:{width}}  {meaning}" for name, meaning in VARIABLES.items())
    parser.epilog = f"Settings in the environment (flags win):\n{table}"


def run(arguments: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    settings = from_environment()
    if arguments.host is not None:
        settings = replace(settings, host=arguments.host)
    if arguments.port is not None:
        settings = replace(settings, port=arguments.port)
    _look_for(arguments.source)
    record = recording_place(arguments)
    chosen_parameters(arguments, "forest")  # a mistyped flag is said now, not on the page

    from app.messages import Open
    from app.parameter_state import ParameterState
    from app.serving import serve

    return serve(
        settings,
        source=Open(arguments.source, arguments.odometry, arguments.seed, record, arguments.publish),
        parameter_state=ParameterState(lambda suggested: chosen_parameters(arguments, suggested)),
        open_browser=not arguments.no_browser,
        viewer=arguments.viewer,
    )


def _look_for(uri: str) -> None:
    """Say at once that a file or a scenario is missing; what is in a file, the worker finds out."""
    if _exists(uri):
        return
    scheme, colon, _ = uri.partition(":")
    if not colon or "/" in scheme or len(scheme) == 1:  # C:\run.mcap has a drive, not a scheme
        raise SourceError(
            "there is no such file or folder", where=uri, remedy="Simulated runs begin with sim:"
        )
    if scheme in ("zenoh", "velodyne"):
        from app.robot.address import parse_address

        parse_address(uri)
    if scheme == "sim":
        from pipeline.simulation.uri import parse_uri

        parse_uri(uri)  # an unknown scenario is said here; the scene itself is built in the worker


def _exists(path: str) -> bool:
    try:
        return Path(path).expanduser().exists()
    except (OSError, ValueError, RuntimeError):  # RuntimeError: a home of nobody
        return False


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not a port (0 to 65535)")
    return int(text)
