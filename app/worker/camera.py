"""Camera picture at the time of a scan. The worker finds it; another process decodes it."""

from __future__ import annotations

from app.robot.source import LiveSource
from app.worker.protocol import CameraPicture
from pipeline.errors import StemmapError
from pipeline.io.readers.base import Source, SourceDescription
from pipeline.io.readers.camera import SHOWN_NS, PictureSource
from pipeline.io.readers.ros_messages import COMPRESSED_IMAGE, IMAGE
from pipeline.odometry.odometry_override import OdometryOverride


def has_camera(description: SourceDescription) -> bool:
    """Return whether a source has camera pictures."""
    return any(t.read_as == "camera" and t.type in (IMAGE, COMPRESSED_IMAGE) for t in description.topics)


def camera_picture(source: Source | None, stamp_ns: int) -> CameraPicture:
    """Return the camera picture of a source that is closest to a time.

    Args:
        source: The open source; None where no run is open.
        stamp_ns: The time [ns].

    Raises:
        StemmapError: The source has no camera, or no picture within `SHOWN_NS` of the time.
    """
    origin: object = source.source if isinstance(source, OdometryOverride) else source
    if source is None or not has_camera(source.description) or not isinstance(origin, PictureSource):
        raise StemmapError("this run has no camera", remedy="Record the topic of a camera as well")
    picture = origin.picture_near(stamp_ns, SHOWN_NS)
    if picture is None:
        raise StemmapError(
            f"no picture was taken within {SHOWN_NS / 1e9:g} s of this scan",
            remedy="Play on, or go to another scan",
        )
    received = origin.picture_counts if isinstance(origin, LiveSource) else ""
    return CameraPicture(picture, *origin.camera(), received)
