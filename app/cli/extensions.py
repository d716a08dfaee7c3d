"""`stemmap extensions`: the extensions that are installed."""

from __future__ import annotations

import argparse

from app.extension import VARIABLE, all_extensions

HELP = "list the extensions that are installed, and whether they are switched on"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add no argument, and the setting to the help."""
    parser.epilog = (
        f"{VARIABLE} names the extensions that are switched on, with commas between; empty switches\n"
        "all of them off. Without it all are on."
    )


def run(_: argparse.Namespace) -> int:
    """Print one line for each extension: name, on, off or broken, what it adds, and its package."""
    rows = [
        (
            each.name,
            "broken" if each.problem else "on" if each.is_on else "off",
            each.problem or (each.extension.help if each.extension else ""),
            each.package,
        )
        for each in all_extensions()
    ]
    width = max([len(name) for name, *_ in rows], default=0)
    for name, state, words, package in rows:
        print(f"{name:{width}}  {state:6}  {words} ({package})")
    if not rows:
        print("no extension is installed; those of stemmap are known after it is installed again")
    return 0
