"""Camera of a recording: its pictures, not decoded, and the projection of points into them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from pipeline.io.readers.base import FileSource
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.message_time import header_stamp
from pipeline.io.readers.topics import CAMERA_INFO, COMPRESSED_IMAGE, decode
from pipeline.io.readers.transforms import TransformTree, frame_name
from pipeline.types.camera import Camera, Picture
from pipeline.types.records import Bool, Int

if TYPE_CHECKING:
    from rosbags.typesys.stores import ros2_jazzy as ros2

#: Larger pictures are refused: bytes as recorded, and pixels.
BYTES_LIMIT, PIXEL_LIMIT = 64 << 20, 40_000_000


def find_camera(
    container: Container, tree: TransformTree, base: str, topic: str
) -> tuple[Camera | None, str]:
    """Return the camera of a topic and "", or None and the reason. Of the CameraInfo topics, the one with the
    most similar name is used, and of its first 20 messages the first valid one. The distortion is ignored.

    Args:
        container: The recording.
        tree: Fixed transforms.
        base: Name of the base frame.
        topic: Topic of the pictures.
    """
    channels = container.by_number
    near = sorted(
        (channel for channel in channels.values() if channel.msgtype == CAMERA_INFO),
        key=lambda channel: (-shared_parts(channel.topic, topic), channel.topic),
    )
    if not near:
        return None, f"there is no CameraInfo for {topic}"
    for message in container.first({near[0].number}, 20):
        try:
            info = decode(channels[message.channel], message.payload)
            K = np.asarray(info.k if hasattr(info, "k") else info.K, dtype=np.float64).reshape(3, 3)
            width, height = int(info.width), int(info.height)
        except Exception:  # noqa: S112 - whatever the generated decoders of rosbags raise
            continue
        if not (
            np.isfinite(K).all() and K[0, 0] > 1.0 and K[1, 1] > 1.0 and 0 < width * height <= PIXEL_LIMIT
        ):
            continue
        linked = tree.find(base, frame_name(info.header.frame_id))
        if linked is None:
            return None, f"there is no fixed transform to {frame_name(info.header.frame_id) or 'the camera'}"
        return Camera(topic, width, height, K, linked), ""
    return None, f"no message of {near[0].topic} is valid"


def shared_parts(first: str, second: str) -> int:
    """Return the number of leading parts between slashes that two topic names share; 99 if one begins with
    all parts of the other."""
    parts = zip(first.split("/"), second.split("/"), strict=False)
    return next((k for k, (a, b) in enumerate(parts) if a != b), 99)


def picture_of(message: Message, channels: Mapping[int, Channel], stamp_ns: int) -> Picture | None:
    """Return the picture in a message; None if it cannot be decoded, the message is longer than BYTES_LIMIT,
    or the sizes of raw pixels contradict each other or exceed PIXEL_LIMIT. Files (JPEG, PNG) are not checked.

    Args:
        message: Image or CompressedImage.
        channels: Dict from numbers to channels.
        stamp_ns: Time of the picture [ns].
    """
    if len(message.payload) > BYTES_LIMIT:
        return None
    channel = channels[message.channel]
    try:
        decoded = decode(channel, message.payload)
        if channel.msgtype == COMPRESSED_IMAGE:
            return Picture(stamp_ns, "", 0, 0, 0, decoded.data.tobytes())
        image: ros2.sensor_msgs__msg__Image = decoded
        width, height, step = int(image.width), int(image.height), int(image.step)
        if not (0 < width * height <= PIXEL_LIMIT and width <= step and step * height <= len(image.data)):
            return None
        return Picture(stamp_ns, str(image.encoding)[:20], width, height, step, image.data.tobytes())
    except Exception:  # the generated decoders of rosbags raise many kinds
        return None


#: Largest time between a scan and a picture of the same place [ns].
SAME_TIME_NS = 150_000_000
#: Largest time between a scan and the picture shown with it [ns], so that a camera with one picture per
#: second has one for each scan. Marks in the picture use the pose of the robot at the time of the picture.
SHOWN_NS = 1_000_000_000


def nearest(stamps: Int, wanted_ns: Int) -> tuple[Int, Bool]:
    """Return the stamp nearest to each time, and whether it is within SAME_TIME_NS of the time.

    Args:
        stamps: Stamps of pictures in ascending order, shape (N,), N >= 1 [ns].
        wanted_ns: Times for which stamps are searched, shape (M,) [ns].

    Returns:
        The nearest stamps [ns], shape (M,), the earlier one of two that are equally near; and whether each
        differs from its time by at most `SAME_TIME_NS`, shape (M,).
    """
    after = np.clip(np.searchsorted(stamps, wanted_ns), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    near = np.where(np.abs(stamps[before] - wanted_ns) <= np.abs(stamps[after] - wanted_ns), before, after)
    return stamps[near], np.abs(stamps[near] - wanted_ns) <= SAME_TIME_NS


#: A picture may be recorded this long before or after a scan of its time [ns].
_EARLY_NS, _LATE_NS = 300_000_000, 1_000_000_000
#: A stamp minus arrival that differs more from that of the scans comes from a clock that was set [ns].
_OTHER_CLOCK_NS = 2_000_000_000


@runtime_checkable
class PictureSource(Protocol):
    """A source with pictures of a camera."""

    def camera(self) -> tuple[Camera | None, str]:
        """Return the camera, or None and the reason why it is unknown, "" when there is no camera."""

    def picture_near(self, stamp_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """Return the picture nearest to a time [ns], None if none is within `within_ns` of it or it cannot be
        decoded."""

    def picture_stamps(self) -> list[int]:
        """Return the times of the pictures that are available, ascending [ns]."""

    def pictures(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """Yield the pictures of some of `picture_stamps` that can be decoded, each once."""


def time_beside(stamp_ns: int | None, log_ns: int, offset_ns: int) -> int:
    """Return the time of a picture of a live run [ns]: its stamp, or its arrival plus `offset_ns` if the
    stamp is missing, 0, or of another clock (_OTHER_CLOCK_NS).

    Args:
        stamp_ns: Stamp in the message of the picture [ns]; None if there is none.
        log_ns: Time of arrival [ns].
        offset_ns: Stamp minus arrival of the first scan of the run [ns].
    """
    if stamp_ns and abs(stamp_ns - log_ns - offset_ns) < _OTHER_CLOCK_NS:
        return stamp_ns
    return log_ns + offset_ns


class MessageSource(FileSource):
    """Parts that sources of recorded messages share: losses, pictures, and closing the recording.

    A subclass sets `_picture_channels`, `_offset_ns` and `base`, and implements `_time_of` and
    `_fixed_transforms`.

    Args:
        container: The recording; the source closes it.

    Attributes:
        base: Name of the base frame, "" when it is unknown.
    """

    base: str
    _picture_channels: Mapping[int, Channel]  # by number
    _offset_ns: int  # time minus time of recording, roughly

    def __init__(self, container: Container) -> None:
        """Begin with the damage of the recording, which is shared, as losses."""
        super().__init__()
        self._container = container
        self._damage = container.damage
        self._camera: tuple[Camera | None, str] | None = None

    def camera(self) -> tuple[Camera | None, str]:
        """Return the camera, or None and the reason why it is unknown, "" when there is no camera. It is
        searched for once."""
        if self._camera is None and self._picture_channels:  # needed for each picture
            topic = next(channel.topic for channel in self._picture_channels.values())
            self._camera = find_camera(self._container, self._fixed_transforms(), self.base, topic)
        return self._camera or (None, "")

    def _fixed_transforms(self) -> TransformTree:
        """Return the fixed transforms. Subclasses implement it."""
        raise NotImplementedError

    def _time_of(self, stamp_ns: int | None, message: Message) -> int | None:
        """Return the time of a picture [ns] by the stamp in its message (None if there is none), or None if
        it is impossible. Subclasses implement it."""
        raise NotImplementedError

    def picture_stamps(self) -> list[int]:
        """Return the times of the pictures, ascending [ns]; reads all pictures of the recording."""
        return sorted(stamp_ns for stamp_ns, _ in self._taken(None))

    def pictures(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """Yield the pictures of some of `picture_stamps` in the order of recording, each once; those that
        cannot be decoded are omitted."""
        left = set(wanted_ns)
        for stamp_ns, message in self._taken(None) if left else ():
            if stamp_ns in left:
                left.discard(stamp_ns)
                picture = picture_of(message, self._picture_channels, stamp_ns)
                if picture is not None:
                    yield picture

    def picture_near(self, stamp_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """Return the picture nearest to a time [ns], None if none is within `within_ns` of it or it cannot be
        decoded."""
        # First only a short interval is read: pictures of a fast camera can be a megabyte each.
        best = self._nearest(stamp_ns, min(within_ns, SAME_TIME_NS)) or self._nearest(stamp_ns, within_ns)
        return None if best is None else picture_of(best[1], self._picture_channels, best[0])

    def close(self) -> None:
        """Close the recording."""
        self._container.close()

    def _nearest(self, stamp_ns: int, within_ns: int) -> tuple[int, Message] | None:
        """Return the time [ns] and message of the picture nearest to a time; None if none is within
        `within_ns` of it."""
        log_ns, best = stamp_ns - self._offset_ns, None
        wider_ns = within_ns - SAME_TIME_NS
        for taken_ns, message in self._taken(log_ns - _EARLY_NS - wider_ns):
            if message.log_ns > log_ns + _LATE_NS + wider_ns:
                break
            off_ns = abs(taken_ns - stamp_ns)
            if off_ns <= within_ns and (best is None or off_ns < abs(best[0] - stamp_ns)):
                best = taken_ns, message
        return best

    def _taken(self, from_log_ns: int | None) -> Iterator[tuple[int, Message]]:
        """Yield the times [ns] and messages of the pictures in the order of recording, from a time of
        recording on [ns] (None: all); those without a possible time are omitted."""
        channels = self._picture_channels
        for message in self._container.messages(channels, from_log_ns, {}) if channels else ():
            stamp_ns = self._time_of(header_stamp(channels[message.channel], message.payload), message)
            if stamp_ns is not None:
                yield stamp_ns, message
