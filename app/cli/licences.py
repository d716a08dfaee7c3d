"""`stemmap licences`: the packages that this installation uses, with versions and licences."""

from __future__ import annotations

import argparse
import re
from importlib.metadata import Distribution, PackageNotFoundError, distribution

HELP = "list the packages that are used, with version and licence"
_NAME = re.compile(r"[A-Za-z0-9._-]+")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add no argument."""
    parser.epilog = "Each line has name, version and licence, separated by tabs."


def run(_arguments: argparse.Namespace) -> int:
    """Print a line per package, ordered by name: stemmap and those that it and its installed extras need,
    directly or not; return 0."""
    for found in sorted(_used("stemmap").values(), key=lambda each: each.name.lower()):
        print(found.name, found.version, _licence(found), sep="\t")
    return 0


def _used(name: str) -> dict[str, Distribution]:
    """Return a package and the installed packages that it needs, directly or not, by normalised name. Extras
    count only for stemmap itself."""
    used: dict[str, Distribution] = {}
    waiting = [name]
    while waiting:
        key = re.sub(r"[-_.]+", "-", waiting.pop()).lower()
        if key in used:
            continue
        try:
            found = distribution(key)
        except PackageNotFoundError:  # of another system, or of an extra that is not installed
            continue
        used[key] = found
        # The extras of others are for their developers.
        needed = [text for text in found.requires or () if key == "stemmap" or "extra ==" not in text]
        waiting += [match.group() for text in needed if (match := _NAME.match(text))]
    return used


def _licence(found: Distribution) -> str:
    """Return the licences that a package declares by its classifiers, else its expression; "unknown" without
    both."""
    about = found.metadata.json
    expression = about.get("license_expression") or about.get("license") or ""
    named = [c.rpartition(" :: ")[2] for c in about.get("classifier", ()) if c.startswith("License ::")]
    return "; ".join(named) or str(expression).strip().partition("\n")[0] or "unknown"
