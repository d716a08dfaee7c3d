"""`stemmap map` of a whole cloud."""

from __future__ import annotations

import argparse

from app.cli import flags
from pipeline.errors import ParameterError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add nothing: the command has all flags."""
    del parser


@flags.compilation_notice()
def run(arguments: argparse.Namespace) -> int | None:
    """Map a whole cloud of a plot and print the result.

    Returns:
        Exit code: 3 if points were left out, or the cloud is a section or a slice of its stems, has coarse
        coordinates or may have another axis up; else 0. None for another source.

    Raises:
        StemmapError: The arguments contradict each other, the cloud or --truth cannot be read, or the folder
            has the map of another source.
        OSError: The folder cannot be written.
    """
    name, parameters = flags.chosen_parameters(arguments, "forest")  # reports a mistyped flag at once

    from app.extensions.clouds.sources import open_cloud, takes

    request = flags.source_request(arguments, arguments.source)
    if not takes(arguments.source, request.options()):
        return None
    if arguments.stop_after is not None:
        raise ParameterError("a whole cloud has no scans", remedy="Remove --stop-after")
    if arguments.repairs is not None:
        raise ParameterError(
            "the map of a whole cloud is repaired on the page", remedy="Remove --repairs, and export there"
        )
    from app.batch.run_folder import check_folder, partial_output_warnings
    from app.cli.map import print_result
    from app.extensions.clouds.cloud_frame import TOO_COARSE
    from app.extensions.clouds.inventory import NO_TREE, SECTION, SLICE, TWICE, UNIT_DOUBT
    from app.extensions.clouds.result_files import map_plot_run
    from app.extensions.clouds.up_axis import UP_UNCLEAR
    from pipeline.io.ground_truth import read_truth_trees

    flags.print_warnings(partial_output_warnings(arguments.out))
    truth = read_truth_trees(arguments.truth, dbh_unit=arguments.dbh_unit) if arguments.truth else None
    cloud = open_cloud(arguments.source, request.options())
    replaces = check_folder(arguments.out, cloud.description.digest, force=arguments.force)
    outcome = map_plot_run(cloud, name, parameters, truth, arguments.out, request.kept_choices())
    return print_result(
        outcome.summary,
        arguments.out,
        outcome.warnings,
        outcome.losses,
        replaces=replaces,
        wrong=(SECTION, SLICE, UP_UNCLEAR, TOO_COARSE, UNIT_DOUBT, TWICE, NO_TREE),
    )
