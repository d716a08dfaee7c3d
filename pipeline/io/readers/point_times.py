"""Times of points: field, unit and clock are decided once for a sensor, by the first scans of its topic.

A sweep lasts about one period between scans, which gives the unit of its times for any clock. Times
that stay the same from scan to scan count from the stamp; others are those of a clock. Without a field of
times, the order of the points may give them (`firing_order`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.io.readers.firing_order import FIRING_ORDER, firing_ns, turn_shares
from pipeline.types.records import Bool, Float32, Int
from pipeline.types.units import SECOND_NS

#: Names of fields with the time of a point, in lower case without underscores, in the order of preference.
TIME_FIELDS = (
    "t", "time", "timestamp", "timeoffset", "offsettime", "timestampoffset", "ts", "dt", "deltatime",
    "reltime", "relativetime", "pointtime", "gpstime",
)  # fmt: skip
#: Units of times [ns] and their names, the largest first.
_UNITS = ((SECOND_NS, "s"), (1_000_000, "ms"), (1_000, "us"), (1, "ns"))
#: A sweep lasts at most this many periods: up to three LiDARs may take turns on a topic.
_PERIODS = 3.2
#: A sweep that is shorter than this share of the period is that of a topic whose scans were thinned out; it
#: lasts at least 10 ms, as no LiDAR sweeps more often than a hundred times a second.
_SHARE, _SHORTEST_NS = 0.2, 10_000_000
#: Longest sweep: scans of a slower topic are thinned out [ns].
LONGEST_NS = SECOND_NS
#: Without a known period, a sweep lasts from a 200th of a second to a little more than a second [ns].
_UNKNOWN = (5_000_000, 1_200_000_000)
#: Points whose times are not within this many sweeps of the median have no valid time.
_REACH = 2.0
#: Times by the clock of the stamps are within this many sweeps of the stamp.
_NEAR = 1.5
#: A shorter delay between stamp and recording is that of a converted recording, which has one time only [ns].
_RECORDED_NS = 1_000_000
#: Share of points that must have valid times.
_ENOUGH = 0.5
#: Spinning sensors turn 10 or 20 times a second, few only 5 times: a topic of 5 Hz is often thinned out [ns].
_TURN_NS = 110_000_000
#: Lasers of spinning LiDARs fire every 46 us (HDL-32E), 50 us (Pandar XT), 53 us (VLS-128) or 55 to 56 us
#: (VLP-16, VLP-32C, Pandar40P and 64, RS-LiDAR, Helios) by their manuals; drivers of Ouster, which fires
#: every 24 to 98 us, write times. Twice as long is that of a topic with every second turn or column [ns].
_FIRING_NS = (44_000, 58_000)
#: Share of points at each end that does not count for the length of a sweep: a few times may be damaged.
_TAIL = 0.01

#: Magnitude from which a floating-point value is no time, whatever its unit.
_LARGEST = 1e30

Column = NDArray[np.generic]
Origin = Literal["stamp", "clock", "first", "last"]
_ORIGINS: dict[Origin, str] = {
    "stamp": "relative to the stamp",
    "clock": "by the clock of the stamp",
    "first": "by another clock than the stamp, which is taken as the time of the first point",
    "last": "by another clock than the stamp, which is taken as the time of the last point",
}


def time_fields(names: Sequence[str]) -> list[str]:
    """Return the names of fields that may have the times of points, the most usual one first."""
    plain = {name: name.lower().replace("_", "") for name in reversed(names)}
    found = [name for name in plain if plain[name] in TIME_FIELDS]
    return sorted(found, key=lambda name: TIME_FIELDS.index(plain[name]))


@dataclass(frozen=True, slots=True)
class PointTimes:
    """How the times of points are read.

    Attributes:
        field: Name of the field, or FIRING_ORDER.
        unit_ns: Unit of its values [ns]: a turn of the sensor for FIRING_ORDER.
        origin: What the times count from: "stamp", the stamp of the scan; "clock", the epoch of the stamps;
            "first" or "last", unknown, so that the first or last point has the time of the stamp.
        sweep_ns: Time between the first and the last point of a scan [ns].
        low_ns, high_ns: Typical times of the first and the last point after the stamp [ns].
    """

    field: str
    unit_ns: int
    origin: Origin
    sweep_ns: int
    low_ns: int = 0
    high_ns: int = 0

    @property
    def words(self) -> str:
        """Field, unit, clock and range, as text for the user."""
        if self.field == FIRING_ORDER:
            return (
                "no usable field; they follow from the order of the points, which is that of firing: 0 to "
                f"{self.high_ns * 1e-9:.3f} s after the stamp"
            )
        unit = next(name for size, name in _UNITS if size == self.unit_ns)
        return (
            f"field {self.field} in {unit}, {_ORIGINS[self.origin]}: {self.low_ns * 1e-9:.3f} to "
            f"{self.high_ns * 1e-9:.3f} s after it"
        )

    def offsets(self, column: Column, stamp_ns: int) -> NDArray[np.int64] | None:
        """Return the times of points relative to the stamp [ns], shape (N,); None if fewer than half of them
        are valid. A time that is not finite, or far from the others, becomes the median.

        Args:
            column: Values of the field, shape (N,).
            stamp_ns: Stamp in the header of the scan [ns].
        """
        centre = _Centred.of(column)
        if centre is None:
            return None
        away = centre.away_ns(self.unit_ns)
        valid = centre.valid & (np.abs(away) <= _REACH * max(self.sweep_ns, _SHORTEST_NS))
        if np.count_nonzero(valid) < _ENOUGH * len(valid):
            return None
        away[~valid] = 0.0
        if self.origin == "stamp":
            start_ns = centre.middle_ns(self.unit_ns)
        elif self.origin == "clock":
            start_ns = centre.middle_ns(self.unit_ns) - stamp_ns
        else:
            start_ns = -round(float(away.min() if self.origin == "first" else away.max()))
        if abs(start_ns) > 2 * LONGEST_NS:
            return None
        return np.rint(away).astype(np.int64) + start_ns


@dataclass(frozen=True, slots=True)
class _Centred:
    """Values of a column about their median: `middle` + `away`, in the unit of the column; rows that are not
    finite are not `valid`. Unsigned counters may wrap around within a scan."""

    middle: int | float
    away: NDArray[np.int64] | NDArray[np.float64]
    valid: Bool

    @classmethod
    def of(cls, column: Column) -> _Centred | None:
        """Return the centred values of a column of numbers, shape (N,); None without a finite one."""
        if column.dtype.kind in "iu":
            valid = np.ones(len(column), np.bool_)
            if not len(column):
                return None
            native = column.astype(column.dtype.newbyteorder("="))
            signed = native.view(f"i{native.dtype.itemsize}")
            with np.errstate(over="ignore"):  # differences of counters are exact modulo their range
                away = (signed - signed[len(signed) // 2]).astype(np.int64)
            shift = int(np.partition(away, len(away) // 2)[len(away) // 2])
            return cls(int(signed[len(signed) // 2]) + shift, away - shift, valid)
        with np.errstate(invalid="ignore", over="ignore"):
            values = column.astype(np.float64)
        valid = np.abs(values) < _LARGEST
        known = values[valid]
        if not len(known):
            return None
        middle = float(np.partition(known, len(known) // 2)[len(known) // 2])
        return cls(middle, np.where(valid, values, middle) - middle, valid)

    def away_ns(self, unit_ns: int) -> NDArray[np.float64]:
        """Return the times after the median [ns], shape (N,)."""
        away: NDArray[np.float64] = self.away.astype(np.float64) * unit_ns
        return away

    def middle_ns(self, unit_ns: int) -> int:
        """Return the median time [ns]: whole units first, as a double holds no nanoseconds since 1970."""
        whole = int(self.middle // 1)
        return whole * unit_ns + round((self.middle - whole) * unit_ns)

    def span(self) -> float:
        """Return the length of the sweep in the unit of the column, without its _TAIL at both ends."""
        low, high = np.quantile(self.away[self.valid], [_TAIL, 1.0 - _TAIL])
        return float(high - low) / (1.0 - 2.0 * _TAIL)


@dataclass(frozen=True, slots=True)
class TimedScan:
    """Columns of a scan that may have the times of its points.

    Attributes:
        stamp_ns: Stamp in the header [ns].
        columns: Dict from names to columns of valid returns, shape (N,).
        points: Points whose order may be that of firing, shape (N, 3) [m]; None if it is not.
        ring: Their ring numbers, shape (N,), or None.
    """

    stamp_ns: int
    columns: Mapping[str, Column]
    points: Float32 | None = None
    ring: Column | None = None


def decide_point_times(scans: Sequence[TimedScan], *, delay_ns: int = 0) -> tuple[PointTimes | None, str]:
    """Decide how the times of points are read.

    Args:
        scans: First scans of a sensor, in their order; scans without points are ignored.
        delay_ns: Time of recording of a scan minus its stamp [ns]; up to 0 if it is unknown. A scan that is
            recorded earlier after its stamp than half a sweep was not stamped at its first point.

    Returns:
        The decision and "". Without a usable field of times, it is that by the order of firing, if most scans
        are in it and follow each other as turns of a sensor. None without a field of times, with "", or if
        none can be used, with the reason.
    """
    names = time_fields(list(dict.fromkeys(name for scan in scans for name in scan.columns)))
    reasons = []
    for name in names:
        found, why = _decide_field(name, scans, delay_ns)
        if found is not None:
            return found, ""
        reasons.append(why)
    in_order, why = _decide_firing_order(scans)
    return in_order, "" if in_order is not None else next(iter(reasons), why)


def _decide_firing_order(scans: Sequence[TimedScan]) -> tuple[PointTimes | None, str]:
    """Return the decision by the order of firing and ""; None and "" if the points are not in this order, and
    None and the reason if scans may have been left out."""
    shares = [None if scan.points is None else turn_shares(scan.points) for scan in scans]
    steps = np.diff(np.array([scan.stamp_ns for scan in scans], np.int64))
    turn_ns = int(np.median(steps[steps > 0])) if (steps > 0).any() else 0
    if not 0 < turn_ns <= _TURN_NS:
        return None, ""
    ends = [share[-1] for share in shares if share is not None]
    if 2 * len(ends) <= len(shares):
        return None, ""
    each = [n for s in scans if s.points is not None and (n := firing_ns(s.points, s.ring, turn_ns))]
    shot_ns = float(np.median(each)) if each else 0.0
    if 2 * _FIRING_NS[0] < shot_ns < 2 * _FIRING_NS[1]:
        return None, (
            f"the points are in the order of firing, {shot_ns * 1e-3:.0f} us apart on a ring if the sensor "
            f"turns once in {turn_ns * 1e-9:.3g} s: LiDARs fire every 46 to 56 us, so every second turn or "
            "column was left out, and it is not known which"
        )
    sweep_ns = round(float(np.median(ends)) * turn_ns)
    return PointTimes(FIRING_ORDER, turn_ns, "stamp", sweep_ns, 0, sweep_ns), ""


def _decide_field(name: str, scans: Sequence[TimedScan], delay_ns: int) -> tuple[PointTimes | None, str]:
    """Return the decision for one field, or None and the reason; see `decide_point_times`."""
    with_field = [scan for scan in scans if name in scan.columns and len(scan.columns[name])]
    centred = [
        (scan.stamp_ns, c) for scan in with_field if (c := _Centred.of(scan.columns[name])) is not None
    ]
    if not centred:
        return None, f"the field {name} has no finite number"
    stamps = np.array([stamp_ns for stamp_ns, _ in centred], np.int64)
    span = float(np.median([c.span() for _, c in centred]))
    if span <= 0.0:
        middle, kind = centred[0][1].middle, with_field[0].columns[name].dtype
        if kind.kind == "u":  # centred values are signed
            middle %= 1 << 8 * kind.itemsize
        return None, f"the field {name} is {middle:.10g} in all points of a scan"
    steps = np.diff(stamps)
    period_ns = int(np.median(steps[steps > 0])) if (steps > 0).any() else 0
    unit_ns = _unit(span, period_ns)
    if unit_ns is None:
        low, high = _limits([scan.columns[name] for scan in with_field])
        scans_apart = f"scans {period_ns * 1e-9:.3g} s apart" if period_ns else "a sweep"
        return (
            None,
            f"the field {name} has values from {low} to {high}, in no unit those of {scans_apart}",
        )
    sweep_ns = round(span * unit_ns)
    middles = [c.middle_ns(unit_ns) for _, c in centred]
    origin = _origin(stamps, middles, sweep_ns, period_ns)
    after = middles if origin == "stamp" else [m - int(s) for m, s in zip(middles, stamps, strict=True)]
    middle_ns = int(np.median(after)) if origin in ("stamp", "clock") else sweep_ns // 2
    if origin == "first" and _RECORDED_NS < delay_ns < sweep_ns // 2:
        origin, middle_ns = "last", -sweep_ns // 2
    low_ns, high_ns = middle_ns - sweep_ns // 2, middle_ns + sweep_ns // 2
    return PointTimes(name, unit_ns, origin, sweep_ns, low_ns, high_ns), ""


def _limits(columns: Sequence[Column]) -> tuple[str, str]:
    """Return the least and the largest valid value of columns, of which one has some, as text."""
    if columns[0].dtype.kind in "iu":
        return str(min(int(c.min()) for c in columns)), str(max(int(c.max()) for c in columns))
    values = np.concatenate([c.astype(np.float64) for c in columns])
    known = values[np.abs(values) < _LARGEST]
    return f"{known.min():.10g}", f"{known.max():.10g}"


def _unit(span: float, period_ns: int) -> int | None:
    """Return the unit [ns] in which a span of times is the length of a sweep; None if there is none.

    Args:
        span: Length of a sweep in the unit, above 0.
        period_ns: Time between scans [ns], 0 if unknown.
    """
    if period_ns <= 0:
        return next((unit for unit, _ in _UNITS if _UNKNOWN[0] <= span * unit <= _UNKNOWN[1]), None)
    period = min(period_ns, LONGEST_NS)
    unit_ns = next((unit for unit, _ in _UNITS if span * unit <= _PERIODS * period), None)
    if unit_ns is None or span * unit_ns < min(_SHARE * period, _SHORTEST_NS):
        return None
    return unit_ns


def _origin(stamps: Int, middles: Sequence[int], sweep_ns: int, period_ns: int) -> Origin:
    """Return what the times count from.

    Args:
        stamps: Stamps of scans [ns], shape (N,).
        middles: Median times of the points of each [ns].
        sweep_ns, period_ns: Length of a sweep and time between scans [ns]; 0 if the latter is unknown.
    """
    near = _NEAR * max(sweep_ns, min(period_ns, LONGEST_NS))
    moves = [
        (after - before) / (int(stamps[k + 1]) - int(stamps[k]))
        for k, (before, after) in enumerate(pairwise(middles))
        if stamps[k + 1] > stamps[k]
    ]
    goes_on = bool(np.median(moves) > 0.5) if moves else abs(middles[0]) > near
    if not goes_on:
        return "stamp" if float(np.median(np.abs(np.array(middles, np.float64)))) <= near else "first"
    off = [abs(middle - int(stamp)) for middle, stamp in zip(middles, stamps, strict=True)]
    return "clock" if float(np.median(np.array(off, np.float64))) <= near else "first"
