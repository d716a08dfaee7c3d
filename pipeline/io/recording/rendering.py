"""Simple pictures of a simulated stand: stems before ground and sky."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np

from pipeline.geometry.poses import Pose3
from pipeline.types.camera import Camera, Picture
from pipeline.types.records import Record, Scan, TruthPath, TruthTrees

TOPIC = "/camera/image/compressed"
WIDTH, HEIGHT, FOCAL = 640, 400, 320.0
#: Extrinsics of the camera, which looks ahead; its axes are x right, y down, z ahead.
T_BASE_CAMERA = Pose3(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.3, 0.0, 0.9])
)
CAMERA = Camera(
    TOPIC,
    WIDTH,
    HEIGHT,
    np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]]),
    T_BASE_CAMERA,
)
#: Number of scans per picture.
EVERY = 5
_HEIGHT = {"tree": 12.0, "pole": 4.0, "person": 1.8, "bush": 1.0, "other": 1.5}
_COLOUR = {"tree": (104, 78, 52), "pole": (150, 150, 155), "person": (190, 70, 60), "bush": (60, 110, 50)}
_THIN, _SIDE, _NEAR = 0.06, 0.8, 0.4  # m


def with_pictures(
    records: Iterator[Record], trees: TruthTrees, path: TruthPath
) -> Iterator[Record | Picture]:
    """Yield the records of a simulated run, and a picture after the first scan and after each EVERY-th scan
    that follows.

    Args:
        records: Records of the run.
        trees: Trees and other objects.
        path: True path, which is interpolated for the poses of the pictures.
    """
    count = 0
    yaw = np.unwrap(path.yaw)
    for record in records:
        yield record
        if isinstance(record, Scan):
            if count % EVERY == 0:
                at = [
                    float(np.interp(record.stamp_ns, path.stamp_ns, axis)) for axis in (path.x, path.y, yaw)
                ]
                yield Picture(record.stamp_ns, "", 0, 0, 0, rendered(trees, (at[0], at[1], at[2])))
            count += 1


def rendered(trees: TruthTrees, pose: tuple[float, float, float]) -> bytes:
    """Return a JPEG of WIDTH x HEIGHT pixels with the objects as rectangles before ground and sky, nearest
    ones last. Objects less than _NEAR in front of the camera or behind it are omitted; one without diameter
    has the width _THIN (a pole) or _SIDE.

    Args:
        trees: Trees and other objects.
        pose: Pose x, y [m], yaw [rad] of the base in the map.
    """
    from PIL import Image, ImageDraw

    picture = Image.new("RGB", (WIDTH, HEIGHT), (168, 196, 214))
    pen = ImageDraw.Draw(picture)
    pen.rectangle([0, HEIGHT // 2, WIDTH, HEIGHT], fill=(92, 104, 66))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = trees.x - pose[0], trees.y - pose[1]
    ahead, left = c * dx + s * dy, c * dy - s * dx
    for row in np.argsort(-ahead, kind="stable"):
        if ahead[row] < _NEAR + T_BASE_CAMERA.t[0]:
            continue
        kind = trees.kind[row]
        dbh = float(trees.dbh[row]) if np.isfinite(trees.dbh[row]) else _THIN if kind == "pole" else _SIDE
        top = _HEIGHT.get(kind, 1.5)
        corners = np.array(
            [[ahead[row], left[row] + side * dbh / 2, z] for side in (1, -1) for z in (0.0, top)]
        )
        pixels, _ = CAMERA.project(corners)
        (x0, y0), (x1, y1) = pixels.min(axis=0), pixels.max(axis=0)
        if x1 < 0 or x0 > WIDTH:
            continue
        shade = float(np.clip(1.2 - ahead[row] / 40.0, 0.4, 1.0))
        colour = tuple(int(shade * part) for part in _COLOUR.get(kind, (120, 120, 120)))
        pen.rectangle([x0, max(y0, 0.0), max(x1, x0 + 1.0), min(y1, float(HEIGHT))], fill=colour)
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=85)
    return out.getvalue()
