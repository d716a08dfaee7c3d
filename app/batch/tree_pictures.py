"""Pictures of the mapped trees, for runs with a camera: selected after the run and written to its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from app.common.draw_picture import Drawing, draw_safely
from pipeline.io.atomic_files import write_beside
from pipeline.io.readers.base import Source
from pipeline.io.readers.camera import PictureSource, nearest
from pipeline.types.camera import Camera
from pipeline.types.records import Bool, Float, Int, Path, Trees

FOLDER = "pictures"
MOST = 300  # pictures
NEAREST, FARTHEST, BEST = 1.5, 15.0, 4.0  # m ahead of the camera
FROM_Z, TO_Z, THIN = 0.0, 2.0, 0.2  # m above the base; width of a stem of unknown diameter


@dataclass(frozen=True, slots=True)
class StemPicture:
    """The best view of a tree.

    Attributes:
        tree: Number of the tree.
        stamp_ns: Time of the picture [ns].
        box: Left, top, right and bottom edge of the stem in the picture [pixels]; it may extend beyond the
            picture.
    """

    tree: int
    stamp_ns: int
    box: tuple[float, float, float, float]


def best_views(camera: Camera, trees: Trees, path: Path, stamps: Int) -> list[StemPicture]:
    """Return the best view of each tree that the camera saw, of the first MOST confirmed ones, ordered by
    time and then by number; [] if there are no pictures.

    Args:
        camera: The camera.
        trees: Trees of the map.
        path: Path of the robot, in the frame of the map.
        stamps: Times of the pictures, ascending, shape (S,) [ns].
    """
    views: list[StemPicture] = []
    if not len(stamps):
        return views
    taken, there = nearest(stamps, path.stamp_ns)
    for row in np.flatnonzero(trees.confirmed)[:MOST]:
        found = _best_view(camera, trees, int(row), path, taken, there)
        if found is not None:
            views.append(found)
    return sorted(views, key=lambda view: (view.stamp_ns, view.tree))


def _best_view(
    camera: Camera, trees: Trees, row: int, path: Path, taken: Int, there: Bool
) -> StemPicture | None:
    """Return the view of a tree with the smallest |ln(depth / BEST)| + 2 |offset| / width, where the offset
    is the horizontal distance of the stem from the middle of the picture; the earliest of equals. None if no
    picture shows the middle of the stem at a depth between NEAREST and FARTHEST.

    Args:
        camera: The camera.
        trees: Trees of the map.
        row: Row of the tree.
        path: Path of the robot, N poses.
        taken: Time of the picture nearest to each pose, shape (N,) [ns].
        there: Whether that picture is near enough in time, shape (N,).
    """
    dx, dy = trees.position[row, 0] - path.x, trees.position[row, 1] - path.y
    c, s = np.cos(path.yaw), np.sin(path.yaw)
    ahead, left = c * dx + s * dy, c * dy - s * dx
    at = np.stack([ahead, left, np.full(len(ahead), 0.5 * (FROM_Z + TO_Z))], axis=1)
    pixels, depth = camera.project(at)
    inside = (
        there & (depth > NEAREST) & (depth < FARTHEST) & (pixels[:, 0] > 0) & (pixels[:, 0] < camera.width)
    )
    inside &= (pixels[:, 1] > 0) & (pixels[:, 1] < camera.height)
    if not inside.any():
        return None
    off_centre = np.abs(pixels[:, 0] - 0.5 * camera.width) / camera.width
    cost = np.where(inside, np.abs(np.log(np.maximum(depth, 1e-3) / BEST)) + 2.0 * off_centre, np.inf)
    k = int(np.argmin(cost))
    seen, _ = camera.project(stem_corners(float(ahead[k]), float(left[k]), float(trees.dbh[row])))
    low, high = seen.min(axis=0), seen.max(axis=0)
    box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return StemPicture(int(trees.number[row]), int(taken[k]), box)


def stem_corners(x: float, y: float, dbh: float) -> Float:
    """Return the corners of a stem as seen from the robot, in the base frame, shape (4, 3) [m]: right and
    left at FROM_Z, right and left at TO_Z.

    Args:
        x, y: Position in the base frame [m], not the origin.
        dbh: Diameter [m]; NaN or infinite if unknown, then the diameter THIN is used.
    """
    half = 0.5 * (dbh if np.isfinite(dbh) else THIN)
    across = np.array([-y, x, 0.0]) * half / np.hypot(x, y)
    return np.array([[x, y, z] + side * across for z in (FROM_Z, TO_Z) for side in (-1.0, 1.0)])


def keep_pictures(source: Source, trees: Trees, path: Path, folder: FilePath) -> tuple[int, str]:
    """Write a picture of each tree of `best_views` to `folder`/pictures, as tree_0001.jpg by its number;
    pictures of an earlier run are deleted, also if there are no new ones.

    Args:
        source: The source, with its camera.
        trees, path: The map.
        folder: Folder of the run.

    Returns:
        Number of written pictures, and a warning or "". Without a camera they are 0 and "", without its
        model 0 and the reason. A picture that cannot be decoded is left out and counted in the warning.

    Raises:
        OSError: An old picture cannot be deleted, or the folder cannot be created.
        StemmapError: A picture cannot be written, or no process can be started to draw it.
    """
    for old in (folder / FOLDER).glob("tree_*.jpg"):
        old.unlink()
    from pipeline.odometry.odometry_override import OdometryOverride  # the web process starts without Numba

    origin: object = source.source if isinstance(source, OdometryOverride) else source
    if not isinstance(origin, PictureSource):
        return 0, ""
    camera, why = origin.camera()
    if camera is None:
        return 0, f"no pictures of trees: {why}" if why else ""
    views = best_views(camera, trees, path, np.array(origin.picture_stamps(), np.int64))
    kept = refused = 0
    for picture in origin.pictures({view.stamp_ns for view in views}):
        for view in (each for each in views if each.stamp_ns == picture.stamp_ns):
            content = draw_safely(Drawing.of(picture, view.box, f"tree {view.tree}"))
            if content is None:
                refused += 1
                continue
            (folder / FOLDER).mkdir(exist_ok=True)
            with write_beside(folder / FOLDER / f"tree_{view.tree:04d}.jpg") as partial:
                partial.write_bytes(content)
            kept += 1
    return kept, f"{refused} pictures could not be decoded" if refused else ""
