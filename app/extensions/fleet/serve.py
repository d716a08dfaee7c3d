"""`stemmap serve` with several sources, or with a router of several robots: a dashboard each, and a page of
all."""

from __future__ import annotations

import argparse

from app.cli.serve import requested


def configure(_: argparse.ArgumentParser) -> None:
    """Add no argument."""


def run(arguments: argparse.Namespace) -> int | None:
    """Serve until Ctrl-C and return the exit code; None for one source. Raises as `app.cli.serve.run`."""
    settings, sources, make_parameters = requested(arguments)

    from app.extensions.fleet.members import named, watched_router

    watched = watched_router(sources)
    if watched is None and len(sources) == 1:
        return None
    from app.extensions.fleet.fleet import serve_fleet

    opened = {} if watched is not None else named(sources)
    return serve_fleet(settings, sources=opened, make_parameters=make_parameters, watched=watched)
