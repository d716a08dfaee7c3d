"""The frame of a whole cloud: the unit of its coordinates and the axis that points up, by what the file says
or what its points show. Inside the program a cloud is in metres, with z up."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.extensions.clouds.cloud_or_scan import CloudSample
from app.extensions.clouds.up_axis import UP, UP_UNCLEAR, turned_words, up_by_ground
from pipeline.io.readers.point_files import DEGREES, PointTable, ScanFileError
from pipeline.types.records import Float

#: Metres per unit; the survey foot of the United States is 1200/3937 m by its definition.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048, "us-ft": 1200.0 / 3937.0}
UNIT_WORDS = {
    "m": "metres", "cm": "centimetres", "mm": "millimetres", "ft": "feet", "us-ft": "US survey feet"
}  # fmt: skip
#: Largest height of a plot with its relief, and side of one [m]; no tree is higher than 116 m.
_HIGHEST, _WIDEST = 150.0, 400.0
#: Lowest height of a plot with stems to breast height [m].
_LOWEST = 0.5
#: Steps of the coordinates that blur a diameter, and that leave no stem [m].
_COARSE, _BLURRED, _LEAVES_NONE = 0.02, 0.05, 0.1
#: First words of the warning about steps above _BLURRED [m], after which stems are missing.
TOO_COARSE = "the coordinates are too coarse for diameters"
#: Coordinates this large are those of a country, which has z up [m].
_NATIONAL = 10_000.0

#: The unit of coordinates of a file that says nothing about it.
UNNAMED = "metres, as the file names no unit"

#: How it is known that another axis than z points up.
TURNED = "by its ground and stems"

_LEAST_POINTS = 1000  # by which the steps of the coordinates are known


@dataclass(frozen=True, slots=True, eq=False)
class FileFrame:
    """How the coordinates of a file become metres with z up: xyz' = R (scale * xyz).

    Attributes:
        scale: Metres per unit of the file, shape (3,).
        up: Axis of the file that points up, a key of UP.
        unit_words: The unit, and how it is known.
        up_words: The axis, and how it is known.
        crs: Reference system of the result, in metres; "" if unknown.
        crs_unit: Metres per unit of the reference system of the file, horizontal and vertical; 1, 1 without
            one.
        warnings: What was changed, for people.
    """

    scale: Float
    up: str
    unit_words: str
    up_words: str
    crs: str
    crs_unit: tuple[float, float]
    warnings: tuple[str, ...]

    @property
    def R(self) -> Float:  # noqa: N802 - the symbol of a rotation
        """Rotation from the axes of the file to those with z up, shape (3, 3)."""
        return UP[self.up]

    def apply(self, xyz: Float) -> Float:
        """Return positions of the file, shape (N, 3), in metres with z up, shape (N, 3)."""
        scaled = xyz if (self.scale == 1.0).all() else xyz * self.scale
        return scaled if self.up == "z" else scaled @ self.R.T


def frame_of(table: PointTable, sample: CloudSample, unit: str = "auto", up: str = "auto") -> FileFrame:
    """Return the frame of a cloud.

    Args:
        table: The file.
        sample: Points of it.
        unit: Key of UNITS, or "auto": by the reference system, by what the file says, or by its extent.
        up: Key of UP, or "auto": by ground and stems.

    Raises:
        ScanFileError: The positions are degrees, too coarse for stems, or of a unit that cannot be known.
    """
    named = _crs_units(table.crs) if table.crs else None
    scale, words, warnings = _scale_of(table, sample, unit, named)
    _check_steps(sample.xyz * scale, warnings)
    crs, crs_unit = table.crs, (1.0, 1.0)
    if named is not None and named != (1.0, 1.0):  # the result is in metres, in whatever unit the file is
        crs = metric_crs(table.crs)
        if unit == "auto" or np.allclose(named, UNITS[unit], rtol=1e-7):
            crs_unit = named
    chosen, up_words = up, "as requested"
    if up == "auto":
        chosen, up_words = "z", "as usual"
        metres = sample.xyz * scale
        if table.crs or (len(metres) and float(np.abs(np.median(metres[:, :2], axis=0)).max()) > _NATIONAL):
            up_words = "as the coordinates are those of a country"
        else:
            chosen, others = up_by_ground(metres)
            if chosen != "z":
                up_words = TURNED
                warnings.append(
                    f"{chosen} points up in the cloud by its ground and stems: it was turned, and x and y "
                    f"of the map are {turned_words(chosen)} of the file (--up z: as it is)"
                )
            elif others:
                up_words = f"as usual, but it may be {' or '.join(others)}"
                warnings.append(
                    f"{UP_UNCLEAR}: z is taken, but ground or stems look as if {' or '.join(others)} points "
                    f"up, and the map is wrong then; name the axis with --up=z, "
                    f"{' or '.join(f'--up={other}' for other in others)}"
                )
    else:
        axes = "" if up == "z" else f": x and y of the map are {turned_words(up)} of it"
        warnings.append(f"{up} of the file points up, as requested{axes}")
    return FileFrame(scale, chosen, words, up_words, crs, crs_unit, tuple(warnings))


# --- units -------------------------------------------------------------------------------------------


def _scale_of(
    table: PointTable, sample: CloudSample, unit: str, crs: tuple[float, float] | None
) -> tuple[Float, str, list[str]]:
    """Return metres per unit of x, y and z, shape (3,), the words for the unit, and warnings.

    Args:
        table, sample, unit: As in `frame_of`.
        crs: Metres per unit of the reference system, horizontal and vertical; None if it names none.

    Raises:
        ScanFileError: The unit cannot be known.
    """
    flat, high = table.units
    if crs is not None:
        scale = np.array([crs[0], crs[0], UNITS[high] if high else crs[1]])
        said = "by its reference system"
    elif flat or high:
        scale = np.array([UNITS[flat or "m"]] * 2 + [UNITS[high or flat or "m"]])
        said = "by the standard of E57" if table.kind.startswith("E57") else "by the file"
    elif unit != "auto":
        scale, said = np.full(3, UNITS[unit]), ""
    else:
        return _scale_by_extent(sample)
    words = _words_of(scale)
    warnings = []
    if unit != "auto":
        chosen = f"{UNIT_WORDS[unit]}, as requested"
        against = "" if np.allclose(scale, UNITS[unit], rtol=1e-7) else f", though they are {words} {said}"
        return np.full(3, UNITS[unit]), chosen, [f"the coordinates are taken as {chosen}{against}"]
    if (scale != 1.0).any():
        warnings.append(
            f"the coordinates are {words} {said}: diameters, heights and all lengths are in metres (or cm)"
            + (", positions in the coordinates of the file" if crs is not None else ", positions too")
        )
    return scale, f"{words}, {said}", warnings


def _words_of(scale: Float) -> str:
    """Return the units of x and y, and of z if it has another one, as text."""
    flat, high = (_unit_words(float(value)) for value in scale[1:])
    return flat if flat == high else f"{flat}, heights {high}"


def _unit_words(metres: float) -> str:
    """Return the name of a unit by its length [m]."""
    near = next((name for name, value in UNITS.items() if abs(value / metres - 1.0) < 1e-7), "")
    return UNIT_WORDS[near] if near else f"units of {metres:.9g} m"


def _scale_by_extent(sample: CloudSample) -> tuple[Float, str, list[str]]:
    """Return scale, words and warnings (as `_scale_of`) of a cloud whose file names no unit.

    Whole numbers are millimetres, because whole metres hold no stem. Other numbers are metres, unless the
    extent of the cloud is none of a plot in metres.

    Raises:
        ScanFileError: The positions are degrees, or two units are possible.
    """
    if len(sample.xyz) < 2:
        return np.ones(3), UNNAMED, []
    low, high = np.percentile(sample.xyz, [0.5, 99.5], axis=0)
    wide = high - low
    if (
        np.abs(sample.xyz[:, :2]).max() <= 360.0
        and wide[:2].max() < 0.02
        and wide[2] > 100.0 * wide[:2].max()
    ):
        raise ScanFileError(*DEGREES)
    extent = " x ".join(f"{side:,.0f}" for side in wide)
    if sample.is_integer and wide.max() > 0.0:
        if not _is_plot(0.001 * wide):
            raise ScanFileError(
                f"its coordinates are whole numbers with an extent of {extent}: no plot in millimetres",
                "Name the unit with --unit mm, cm, m, ft or us-ft",
            )
        return (
            np.full(3, 0.001),
            "millimetres, as the coordinates are whole numbers",
            [f"the coordinates are whole numbers with an extent of {extent}, taken as millimetres: all "
             "results are in metres (--unit names another unit)"],
        )  # fmt: skip
    if wide.min() <= 1000.0:
        return np.ones(3), UNNAMED, []
    fitting = [name for name in ("mm", "cm") if _is_plot(UNITS[name] * wide)]
    if len(fitting) != 1:
        raise ScanFileError(
            f"its extent of {extent} cannot be metres, and the file names no unit",
            f"Name it with {' or '.join(f'--unit {name}' for name in fitting or UNITS)}",
        )
    words = UNIT_WORDS[fitting[0]]
    return (
        np.full(3, UNITS[fitting[0]]),
        f"{words}, as its extent fits no other unit",
        [f"the cloud has an extent of {extent}, which only fits a plot in {words}: all results are in metres "
         "(--unit names another unit)"],
    )  # fmt: skip


def _is_plot(wide: Float) -> bool:
    """Return whether an extent, shape (3,) [m], can be that of a plot with stems."""
    return bool(wide.min() >= _LOWEST and wide.min() <= _HIGHEST and wide.max() <= _WIDEST)


def _check_steps(metres: Float, warnings: list[str]) -> None:
    """Check that neighbouring values of the coordinates are fine enough for stems: an export of national
    coordinates as 32-bit numbers leaves steps of up to 0.5 m.

    Args:
        metres: Points, shape (N, 3) [m].
        warnings: A warning is added for steps that blur diameters.

    Raises:
        ScanFileError: The steps leave no stems.
    """
    if len(metres) < _LEAST_POINTS:
        return
    steps = [float(np.diff(values).min()) for values in map(np.unique, metres.T) if len(values) > 1]
    step = max(steps, default=0.0)
    if step <= _COARSE:
        return
    words = (
        f"its coordinates, as large as {np.abs(metres).max():,.0f} m, are in steps of {100.0 * step:.0f} cm"
    )
    if step > _LEAVES_NONE:
        raise ScanFileError(
            f"{words}, which leaves no stems",
            "Export it again with 64-bit numbers or more digits, or with a shift",
        )
    doubt = f"{TOO_COARSE}: " if step > _BLURRED else ""
    warnings.append(
        f"{doubt}{words}: diameters are uncertain; export it with 64-bit numbers, or with a shift"
    )


# --- reference systems ---------------------------------------------------------------------------------


def _crs_units(text: str) -> tuple[float, float] | None:
    """Return metres per unit of a reference system, horizontal and vertical; heights without a system of
    their own have the unit of the positions. None if it is unknown.

    Raises:
        ScanFileError: The system is geographic or geocentric.
    """
    import pyproj

    try:
        crs = pyproj.CRS.from_user_input(text)
    except pyproj.exceptions.ProjError:
        return None
    while crs.is_bound and crs.source_crs is not None:
        crs = crs.source_crs
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    while parts[0].is_bound and parts[0].source_crs is not None:
        parts[0] = parts[0].source_crs
    if parts[0].is_geographic:
        raise ScanFileError(*DEGREES)
    if parts[0].is_geocentric:
        raise ScanFileError("its positions count from the centre of the Earth", DEGREES[1])
    axes = parts[0].axis_info
    if not axes or parts[0].is_vertical:
        return None
    flat = float(axes[0].unit_conversion_factor)
    vertical = parts[1].axis_info if len(parts) > 1 else axes[2:]
    high = float(vertical[0].unit_conversion_factor) if vertical else flat
    return (flat, high) if flat > 0.0 and high > 0.0 else None


def metric_crs(text: str) -> str:
    """Return a reference system with metres in place of other units of its axes: "EPSG:26954" or
    "EPSG:6429+5703" where PROJ knows it, else as WKT.

    Raises:
        pyproj.exceptions.ProjError: The system is unknown.
    """
    import pyproj

    record = pyproj.CRS.from_user_input(text).to_json_dict()
    _use_metres(record)
    codes = [_known_number(part, record.get("$schema", "")) for part in record.get("components", [record])]
    if all(codes):
        return f"EPSG:{'+'.join(map(str, codes))}"
    return str(pyproj.CRS.from_json(json.dumps(record)).to_wkt())


def _use_metres(record: dict[str, Any]) -> None:
    """Replace the units of the axes of a reference system (PROJJSON) by metres, in place; a geographic base
    is not changed."""
    for part in record.get("components", []):
        _use_metres(part)
    if "source_crs" in record:
        _use_metres(record["source_crs"])
    axes = record.get("coordinate_system", {}).get("axis", [])
    if any(axis.get("unit") != "metre" for axis in axes):
        record["name"] = re.sub(r" \((ft|ftUS)\)$", "", record.get("name", "unknown")) + _IN_METRES
    for axis in axes:
        axis["unit"] = "metre"
    if "components" in record:
        record["name"] = " + ".join(part["name"] for part in record["components"])
    record.pop("id", None)


_IN_METRES = " in metres"


def _known_number(record: dict[str, Any], schema: str) -> int | None:
    """Return the EPSG number of a reference system (PROJJSON) in metres; None if PROJ knows none."""
    import pyproj

    name = record["name"]
    if record.get("type") == "VerticalCRS":  # of heights the name decides
        name = name.removesuffix(_IN_METRES)
    try:
        number = pyproj.CRS.from_json(json.dumps({"$schema": schema, **record, "name": name})).to_epsg()
        known = None if number is None else pyproj.CRS.from_epsg(number)
    except pyproj.exceptions.ProjError:
        return None
    if known is None or any(axis.unit_conversion_factor != 1.0 for axis in known.axis_info):
        return None
    return int(known.to_epsg())
