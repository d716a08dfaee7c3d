"""A file of points as a whole cloud of a plot, read part by part."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from app.extensions.clouds.cloud_frame import FileFrame, frame_of
from app.extensions.clouds.cloud_or_scan import CloudSample, form_of, is_decided_by_points, sample_of
from app.extensions.clouds.records import CloudDescription
from pipeline.errors import SourceError
from pipeline.io.readers.base import COORDINATE_LIMIT, SourceOptions, count_loss, digest_of
from pipeline.io.readers.point_files import EXPORT, MISSING, REMEDY, PointTable, ScanFileError, open_table
from pipeline.types.records import Float, Float32

_AXES = ("x", "y", "z")


def open_cloud(uri: str, options: SourceOptions | None = None) -> PointCloud:
    """Open a whole cloud by its first bytes or its suffix: LAS or LAZ, PLY, NumPy, PCD, or a format that was
    added.

    Args:
        uri: Path as the user wrote it.
        options: Choices of the user, of which the unit and the axis that points up are used; None for none.

    Raises:
        SourceError: The file does not exist, has an unknown format, or is damaged; or its unit is unknown.
    """
    try:
        path = Path(uri).expanduser()
        return PointCloud(uri, path, open_table(path), options or SourceOptions())
    except ScanFileError as error:
        raise SourceError(str(error), where=uri, remedy=error.remedy) from None
    except MemoryError:
        raise SourceError("it is too large for the memory of this machine", where=uri) from None
    except (OSError, ValueError, RuntimeError) as error:  # a path with a zero byte, an unknown home
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise SourceError(
            f"cannot open: {reason}", where=uri, remedy="Look at the path and its rights"
        ) from None


def is_place(xyz: Float) -> NDArray[np.bool_]:
    """Return which positions, shape (N, 3) [m], are finite with magnitudes below COORDINATE_LIMIT, shape
    (N,)."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.isfinite(xyz) & (np.abs(xyz) < COORDINATE_LIMIT)).all(axis=1))


def offset_for(middle: Float) -> Float:
    """Return the offset of a cloud by a position in it, shape (3,) [m]: per axis, 0 for a magnitude below
    1000 m, else the position rounded to 100 m.

    The offset has whole hundreds of metres, so 32 bits hold the rest of the coordinates without loss.
    """
    return np.where(np.abs(middle) < 1000.0, 0.0, np.round(middle / 100.0) * 100.0)


class PointCloud:
    """A file of points as a cloud (see `app.extensions.clouds.records.WholeCloud`).

    Args:
        uri: Path as the user wrote it.
        path: The file.
        table: Table of the file.
        options: Choices of the user.

    Raises:
        ScanFileError: The file is damaged, has no valid point, or its unit is unknown.
        OSError: The file cannot be read.
    """

    def __init__(self, uri: str, path: Path, table: PointTable, options: SourceOptions) -> None:
        """Read a sample of the points, which decides unit and axes, the first points, which decide the
        offset, and the digest.

        Raises:
            ScanFileError: The file is damaged, has no valid point, or its unit is unknown.
            OSError: The file cannot be read.
        """
        self._table = table
        self.losses: dict[str, int] = {}
        sample = sample_of(table)
        self._frame = frame = frame_of(table, sample, options.unit, options.up)
        for xyz in self._positions():
            first = xyz[is_place(xyz)][:1000]
            if len(first):
                break
        else:
            raise ScanFileError("the cloud has no points with valid coordinates", EXPORT)
        low, high = _corners(table, sample, frame)
        form = form_of(table, sample) if options.form == "auto" and is_decided_by_points(table) else None
        self.description = CloudDescription(
            uri,
            table.kind,
            table.points,
            offset_for(first.mean(axis=0)),
            crs=frame.crs,
            digest=digest_of([path]),
            warnings=((form.words,) if form is not None and form.is_cloud else ()) + frame.warnings,
            low=low,
            high=high,
            attributes=(*(name for name in table.names if name not in _AXES), *table.attributes),
            cut_above=table.cut_above,
            unit=frame.unit_words,
            up=f"{frame.up}, {frame.up_words}",
            form="as requested" if options.form == "cloud" else form.why if form is not None else "",
            crs_unit=frame.crs_unit,
        )

    def parts(self) -> Iterator[Float32]:
        """Yield all points part by part, relative to `description.offset`, float32, shape (N, 3) [m]; parts
        may be empty. `losses` is reset; points without valid coordinates, and those missing after damage, are
        counted in it.

        Raises:
            SourceError: The file cannot be read, or is damaged, before its first point.
        """
        self.losses = {}
        read = 0
        try:
            for xyz in self._positions():
                with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers may have any size
                    xyz = xyz - self.description.offset
                good = is_place(xyz)
                read += len(xyz)
                bad = ~good & ~np.isnan(xyz).all(axis=1) if self._table.has_voids else ~good
                if bad.any():
                    count_loss(self.losses, self._table.invalid, int(np.count_nonzero(bad)))
                yield xyz[good].astype(np.float32)
        except OSError as error:
            what = f"cannot read: {error.strerror or error}"
            raise SourceError(what, where=self.description.uri, remedy=REMEDY) from None
        except ScanFileError as error:
            raise SourceError(str(error), where=self.description.uri, remedy=error.remedy) from None
        if read < self.description.points and self._table.exact:
            count_loss(self.losses, MISSING, self.description.points - read)

    def _positions(self) -> Iterator[Float]:
        """Yield the coordinates of all rows, valid or not, shape (N, 3), in metres with z up; errors are
        those of `PointTable.parts`."""
        for columns in self._table.parts():
            with np.errstate(over="ignore", invalid="ignore"):
                yield self._frame.apply(
                    np.stack([columns[axis].astype(np.float64) for axis in _AXES], axis=1)
                )


def _corners(
    table: PointTable, sample: CloudSample, frame: FileFrame
) -> tuple[Float, Float] | tuple[None, None]:
    """Return the lowest and the highest corner of a cloud in metres with z up, shape (3,) each: by the
    header, else those of the sample; None if neither is known."""
    if table.low is not None and table.high is not None:
        corners = np.stack([table.low, table.high])
    elif len(sample.xyz):
        corners = np.stack([sample.xyz.min(axis=0), sample.xyz.max(axis=0)])
    else:
        return None, None
    with np.errstate(over="ignore", invalid="ignore"):
        turned = frame.apply(corners)
    return (turned[0], turned[1]) if frame.up == "z" else (turned.min(axis=0), turned.max(axis=0))
