"""Records of a camera: its model and a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.poses import Float, Pose3


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera on the robot, without lens distortion.

    Attributes:
        topic: Topic of the pictures.
        width, height: Size of a picture [pixels].
        K: Camera matrix, shape (3, 3) [pixels].
        T_base_camera: Extrinsics; the axes of the camera are x right, y down, z ahead.
    """

    topic: str
    width: int
    height: int
    K: Float
    T_base_camera: Pose3

    def project(self, points: Float) -> tuple[Float, Float]:
        """Return the pixels x, y, shape (N, 2), and the depths, shape (N,) [m], of points. Pixels may be
        outside of the picture; for a depth of 0 or less they have no meaning (inf or NaN at 0).

        Args:
            points: Points in the base frame, shape (N, 3) [m].
        """
        seen = self.T_base_camera.inverse().apply(points)
        depth = seen[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = (seen @ self.K.T)[:, :2] / depth[:, None]
        return pixels, depth


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One picture as it was recorded.

    Attributes:
        stamp_ns: Time of the picture [ns].
        encoding: "" for a file (JPEG, PNG), else the encoding of raw pixels, e.g. "rgb8".
        width, height, step: Size of raw pixels and bytes per row; 0 for a file.
        data: Bytes of the file or of the raw pixels.
    """

    stamp_ns: int
    encoding: str
    width: int
    height: int
    step: int
    data: bytes
