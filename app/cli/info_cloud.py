"""What `stemmap info` says of a whole cloud of a plot."""

from __future__ import annotations

import json
import shlex
from typing import Any

import numpy as np

from app.cli.choices import plain, program
from app.common.text import count
from pipeline.inventory.cloud import CloudDescription

SQUARE_M = 1.0  # least area over which points are counted [m^2]


def say(d: CloudDescription, *, as_json: bool) -> None:
    """Print what is known of a cloud before its points are read."""
    print(json.dumps(_record(d), indent=1, allow_nan=False) if as_json else "\n".join(_lines(d)))


def _record(d: CloudDescription) -> dict[str, Any]:
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
        "attributes": list(d.attributes),
        "warnings": list(d.warnings),
    }


def _lines(d: CloudDescription) -> list[str]:
    rows = [
        ("kind", f"whole cloud, {d.kind}"),
        ("points", f"{d.points:,}"),
        *_extent_rows(d),
        ("CRS", _crs_words(d.crs)),
        ("each has", ", ".join(map(plain, d.attributes)) or "its place alone"),
        ("truth", "give trees with --truth trees.csv, in the coordinates of the cloud"),
        ("SHA-256", d.digest),
    ]
    uri, command = shlex.quote(d.uri), program()
    return [
        *(f"{name:10}{text}" for name, text in rows),
        *(f"warning: {text}" for text in d.warnings),
        "",
        f"map it:        {command} map {uri} --out out",
        f"drive through: {command} {uri}   (a simulated robot; `sim:cloud?file=` takes options)",
    ]


def _extent(d: CloudDescription) -> tuple[np.ndarray, np.ndarray] | None:
    """The corners, None where what the file promises is no extent."""
    if d.low is None or d.high is None:
        return None
    with np.errstate(invalid="ignore", over="ignore"):
        is_extent = np.isfinite(d.low).all() and np.isfinite(d.high).all() and bool((d.high >= d.low).all())
    return (d.low, d.high) if is_extent else None


def _extent_rows(d: CloudDescription) -> list[tuple[str, str]]:
    extent = _extent(d)
    if extent is None:
        return [("extent", "the file does not say it")]
    (x, y, z), (to_x, to_y, to_z) = (corner.tolist() for corner in extent)
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
    """The reference system by its name, so that nobody has to read pages of it."""
    if not crs:
        return "not said: positions stay those of the cloud, without longitude and latitude"
    import pyproj

    try:
        known = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.ProjError:
        return "not understood: positions stay those of the cloud, without longitude and latitude"
    code = known.to_authority()
    return plain(known.name) + (f" ({':'.join(code)})" if code else "")
