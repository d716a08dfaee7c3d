"""`stemmap params`: every parameter as a table, or a preset as TOML."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from app.cli.choices import add_parameter_flags, chosen_parameters

if TYPE_CHECKING:
    from pipeline.config import Parameters

HELP = "list every parameter, or print a preset as a TOML file"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the flags."""
    add_parameter_flags(parser)
    parser.add_argument(
        "--format",
        choices=("table", "toml", "markdown"),
        default="table",
        help="table for reading, toml for --config, markdown for the README",
    )


def run(arguments: argparse.Namespace) -> int:
    """Print them."""
    from pipeline.config import PRESETS, markdown_table, preset, to_toml

    name, parameters = chosen_parameters(arguments, "forest")
    if arguments.format == "toml":
        print(to_toml(parameters), end="")
    elif arguments.format == "markdown":
        print(markdown_table({p: preset(p) for p in PRESETS}), end="")
    else:
        _print_table(name, parameters)
    return 0


def _print_table(name: str, parameters: Parameters) -> None:
    from app.common.preset_text import preset_words
    from pipeline.config import field_specs

    words = preset_words(name, parameters)
    print(f"{words[0].upper()}{words[1:]}. Change a value with --set stage.name=value.\n")
    values = parameters.flat()
    for spec in field_specs():
        if spec.kind == "name":
            bounds = "a name"
        elif spec.minimum is None:
            bounds = " | ".join(spec.choices) or "true | false"
        else:
            bounds = f"{spec.minimum:g} .. {spec.maximum:g} {spec.unit}".rstrip()
        print(f"{spec.name} = {values[spec.name]}   [{bounds}]\n    {spec.doc}")
