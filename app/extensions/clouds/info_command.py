"""`stemmap info` of a whole cloud."""

from __future__ import annotations

import argparse
import json
import shlex
from typing import TYPE_CHECKING, Any

from app.cli.flags import plain, program, source_request

if TYPE_CHECKING:
    import numpy as np

    from app.extensions.clouds.records import CloudDescription


def configure(parser: argparse.ArgumentParser) -> None:
    """Add nothing: the command has all flags."""
    del parser


def run(arguments: argparse.Namespace) -> int | None:
    """Print the description of a whole cloud as lines or, with --json, as JSON, and return 0; None for
    another source. Raises StemmapError if the cloud cannot be read."""
    from app.extensions.clouds.sources import open_cloud, takes

    options = source_request(arguments, arguments.source).options()
    if not takes(arguments.source, options):
        return None
    cloud = open_cloud(arguments.source, options).description
    if arguments.json:
        print(json.dumps(_cloud_record(cloud), indent=1, allow_nan=False))
    else:
        print("\n".join(_cloud_lines(cloud)))
    return 0


SQUARE_M = 1.0  # smallest area for the point density [m^2]


def _cloud_record(d: CloudDescription) -> dict[str, Any]:
    """Return the description of a cloud as JSON values: `uri`, `kind`, `digest`, number of `points`, the
    corners `low_m` and `high_m` (None without a valid extent), `offset_m`, `crs` (in metres; None without),
    `unit` and `up` with their sources, `form` (why it is taken as a whole cloud; "" for a format of clouds),
    `attributes` and `warnings`."""
    extent = _extent(d)
    return {
        "uri": d.uri,
        "kind": d.kind,
        "digest": d.digest,
        "points": d.points,
        "low_m": None if extent is None else extent[0].tolist(),
        "high_m": None if extent is None else extent[1].tolist(),
        "offset_m": d.offset.tolist(),
        "crs": d.crs or None,
        "unit": d.unit,
        "up": d.up,
        "form": d.form,
        "attributes": list(d.attributes),
        "warnings": list(d.warnings),
    }


def _cloud_lines(d: CloudDescription) -> list[str]:
    """Return the description of a cloud as lines: a figure a line, warnings, and the commands to map it and
    to drive through it."""
    rows = [
        ("kind", f"whole cloud, {d.kind}"),
        ("points", f"{d.points:,}"),
        *([("taken so", plain(d.form))] if d.form else []),
        *_extent_rows(d),
        ("unit", plain(d.unit)),
        ("up", plain(d.up)),
        ("CRS", _crs_words(d.crs)),
        ("attributes", ", ".join(map(plain, d.attributes)) or "only its position"),
        ("truth", "give true trees with --truth trees.csv, in the coordinates of the cloud"),
        ("SHA-256", d.digest),
    ]
    uri, command = shlex.quote(d.uri), program()
    return [
        *(f"{name:11}{text}" for name, text in rows),
        *(f"warning: {text}" for text in d.warnings),
        "",
        f"map it:        {command} map {uri} --out out",
        f"drive through: {command} 'sim:cloud?file={uri}'   (a simulated robot)",
    ]


def _extent(d: CloudDescription) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lowest and the highest corner of a cloud, shape (3,) each [m]; None if the file has no valid
    extent."""
    import numpy as np

    if d.low is None or d.high is None:
        return None
    with np.errstate(invalid="ignore", over="ignore"):
        is_extent = np.isfinite(d.low).all() and np.isfinite(d.high).all() and bool((d.high >= d.low).all())
    return (d.low, d.high) if is_extent else None


def _extent_rows(d: CloudDescription) -> list[tuple[str, str]]:
    """Return rows (name, text) with size, point density and corners; one row "unknown" without a valid
    extent."""
    extent = _extent(d)
    if extent is None:
        return [("extent", "unknown")]
    (x, y, z), (to_x, to_y, to_z) = (corner.tolist() for corner in extent)
    from app.common.text import count

    wide, long = to_x - x, to_y - y
    dense = d.points / max(wide * long, SQUARE_M)
    return [
        (
            "extent",
            f"{wide:.1f} x {long:.1f} m, {to_z - z:.1f} m high; {count(round(dense), 'point')} per m²",
        ),
        ("from", f"x {x:.2f}, y {y:.2f}, z {z:.2f} m"),
        ("to", f"x {to_x:.2f}, y {to_y:.2f}, z {to_z:.2f} m"),
    ]


def _crs_words(crs: str) -> str:
    """Return the name of a reference system, given as WKT or "EPSG:...", with its code; a remark for "" and
    for an unknown one."""
    if not crs:
        return "none: positions have no longitude and latitude"
    import pyproj

    try:
        known = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.ProjError:
        return "unknown: positions have no longitude and latitude"
    code = known.to_authority()
    return plain(known.name) + (f" ({':'.join(code)})" if code else "")
