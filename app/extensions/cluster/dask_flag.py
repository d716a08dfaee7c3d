"""The flag --dask: a command computes its tasks on a Dask cluster."""

from __future__ import annotations

import argparse


def configure(parser: argparse.ArgumentParser) -> None:
    """Add --dask."""
    parser.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="compute on the workers of this Dask scheduler, such as tcp://host:8786; they need this "
        "version, and the runs at the same paths",
    )


def check(arguments: argparse.Namespace) -> None:
    """Set the pool of the command to the cluster of --dask.

    Raises:
        StemmapError: The extra `dask` is not installed.
    """
    if arguments.dask is not None:
        from app.extensions.cluster.dask_pool import DaskPool

        arguments.pool = DaskPool(arguments.dask)


def run(arguments: argparse.Namespace) -> None:
    """Leave the work to the command."""
    del arguments
