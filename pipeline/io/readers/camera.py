"""Pictures of a recording's camera, and where things of the map stand in them; nothing is decoded here."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Protocol, cast, runtime_checkable

import numpy as np

from pipeline.geometry.poses import Float, Pose3
from pipeline.io.readers import ros_messages
from pipeline.io.readers.container import Channel, Container, Message, plain_message
from pipeline.io.readers.message_time import header_stamp
from pipeline.io.readers.ros_messages import CAMERA_INFO, COMPRESSED_IMAGE, MessageDecoder
from pipeline.io.readers.transforms import TransformTree, frame_name
from pipeline.types.records import Bool, Int

#: Larger pictures are not looked at: bytes as recorded, and pixels.
BYTES_LIMIT, PIXEL_LIMIT = 64 << 20, 40_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera on the robot; its lens's distortion is not taken into account.

    Attributes:
        topic: Of its pictures.
        width, height: Of a picture [pixels].
        K: Focal lengths and centre, shape (3, 3) [pixels].
        T_base_camera: Where it stands; its axes are x right, y down, z ahead.
    """

    topic: str
    width: int
    height: int
    K: Float
    T_base_camera: Pose3

    def project(self, points: Float) -> tuple[Float, Float]:
        """Pixels, shape (N, 2), and depths [m], shape (N,), of points in the base frame, shape (N, 3)."""
        seen = self.T_base_camera.inverse().apply(points)
        depth = seen[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = (seen @ self.K.T)[:, :2] / depth[:, None]
        return pixels, depth


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One picture as it was recorded.

    Attributes:
        stamp_ns: When it was taken.
        encoding: "" for a file (JPEG, PNG), else that of its raw pixels, e.g. "rgb8".
        width, height, step: Of raw pixels; 0 for a file.
        data: Its bytes.
    """

    stamp_ns: int
    encoding: str
    width: int
    height: int
    step: int
    data: bytes


def find_camera(
    container: Container,
    decoder: MessageDecoder,
    tree: TransformTree,
    base: str,
    pictures: frozenset[int],
) -> tuple[Camera | None, str]:
    """The camera of some channels of pictures by its CameraInfo and the transforms; None and why.

    Args:
        container, decoder: The recording and what reads its messages.
        tree: Its fixed transforms.
        base: Name of the base frame.
        pictures: Numbers of the channels.
    """
    channels: dict[int, Channel] = {channel.number: channel for channel in container.channels}
    topic = next(channels[number].topic for number in sorted(pictures))
    near = sorted(
        (channel for channel in channels.values() if channel.msgtype == CAMERA_INFO),
        key=lambda channel: (-shared_parts(channel.topic, topic), channel.topic),
    )
    if not near:
        return None, f"no CameraInfo tells of {topic} where things stand in it"
    for message in islice(container.messages({near[0].number}, None, {}), 20):
        try:
            plain = plain_message(message.payload)
            info = cast(ros_messages.CameraInfo, decoder.decode(channels[message.channel], plain))
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
            return None, f"no fixed transform tells where {frame_name(info.header.frame_id) or 'it'} stands"
        return Camera(topic, width, height, K, linked), ""
    return None, f"nothing sound is told in {near[0].topic}"


def shared_parts(first: str, second: str) -> int:
    """How many parts two topics share from the front."""
    parts = zip(first.split("/"), second.split("/"), strict=False)
    return next((k for k, (a, b) in enumerate(parts) if a != b), 99)


def picture_of(
    message: Message, channels: Mapping[int, Channel], decoder: MessageDecoder, stamp_ns: int
) -> Picture | None:
    """A message as a picture, None where its sizes contradict one another or are beyond all bounds."""
    if len(message.payload) > BYTES_LIMIT:
        return None
    channel = channels[message.channel]
    try:
        decoded = decoder.decode(channel, message.payload)
        if channel.msgtype == COMPRESSED_IMAGE:
            return Picture(stamp_ns, "", 0, 0, 0, cast(ros_messages.CompressedImage, decoded).data.tobytes())
        image = cast(ros_messages.Image, decoded)
        width, height, step = int(image.width), int(image.height), int(image.step)
        if not (0 < width * height <= PIXEL_LIMIT and width <= step and step * height <= len(image.data)):
            return None
        return Picture(stamp_ns, str(image.encoding)[:20], width, height, step, image.data.tobytes())
    except Exception:  # whatever the generated decoders of rosbags raise
        return None


#: A picture that is farther from a scan in time is not taken for one of its place [ns].
SAME_TIME_NS = 150_000_000
#: One that is shown beside a scan may be so far from it [ns]: cameras of one picture a second, too, have a
#: picture for each scan. How far it is is said, and things are marked as seen from where the robot was then.
SHOWN_NS = 1_000_000_000


def nearest(stamps: Int, wanted_ns: Int) -> tuple[Int, Bool]:
    """Of times (ascending, N >= 1) the nearest to each wanted one, and whether it is near enough."""
    after = np.clip(np.searchsorted(stamps, wanted_ns), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    near = np.where(np.abs(stamps[before] - wanted_ns) <= np.abs(stamps[after] - wanted_ns), before, after)
    return stamps[near], np.abs(stamps[near] - wanted_ns) <= SAME_TIME_NS


#: A picture may be written so long before a scan of its time is stamped, and so long after.
_EARLY_NS, _LATE_NS = 300_000_000, 1_000_000_000
#: A stamp that is farther from its arrival than that of the scans was made by a clock that was set meanwhile.
_OTHER_CLOCK_NS = 2_000_000_000


@runtime_checkable
class WithPictures(Protocol):
    """A source that may have pictures."""

    def camera(self) -> tuple[Camera | None, str]:
        """How the camera stands; None and why where nobody tells, or there is none ("")."""

    def picture_near(self, stamp_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """The picture that was taken nearest to a time, None where none is within `within_ns` of it."""

    def picture_stamps(self) -> list[int]:
        """When pictures were taken that can still be had, ascending [ns]."""

    def pictures(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """The pictures that were taken at some of `picture_stamps`, each once."""


def time_beside(stamp_ns: int | None, log_ns: int, offset_ns: int) -> int:
    """The time of a picture of a live run [ns].

    Args:
        stamp_ns: In its message, if any.
        log_ns: When it came.
        offset_ns: Stamp minus arrival of the run's first scan.
    """
    if stamp_ns and abs(stamp_ns - log_ns - offset_ns) < _OTHER_CLOCK_NS:
        return stamp_ns
    return log_ns + offset_ns


class RecordedPictures:
    """The pictures of some channels.

    Args:
        container, decoder: The recording and what reads its messages.
        channels: Of the recording, by number.
        numbers: Of the channels of pictures.
        time_of: A message's time [ns] from its stamp, None where that is impossible.
        offset_ns: Times minus times of writing, roughly.
    """

    def __init__(
        self,
        container: Container,
        decoder: MessageDecoder,
        channels: Mapping[int, Channel],
        numbers: frozenset[int],
        time_of: Callable[[int | None, Message], int | None],
        offset_ns: int,
    ) -> None:
        self._container, self._decoder, self._channels = container, decoder, channels
        self._numbers, self._time_of, self._offset_ns = numbers, time_of, offset_ns

    def stamps(self) -> list[int]:
        """When they were taken, ascending [ns]."""
        return sorted(stamp_ns for stamp_ns, _ in self._stamped(None))

    def at(self, wanted_ns: Collection[int]) -> Iterator[Picture]:
        """Those that were taken at some of `stamps`, each once."""
        left = set(wanted_ns)
        for stamp_ns, message in self._stamped(None) if left else ():
            if stamp_ns in left:
                left.discard(stamp_ns)
                picture = picture_of(message, self._channels, self._decoder, stamp_ns)
                if picture is not None:
                    yield picture

    def near(self, stamp_ns: int, within_ns: int = SAME_TIME_NS) -> Picture | None:
        """The one that was taken nearest to a time, None where that is farther from it than `within_ns`."""
        # Of a fast camera only the pictures around the time are read: they can be a megabyte each.
        best = self._nearest(stamp_ns, min(within_ns, SAME_TIME_NS)) or self._nearest(stamp_ns, within_ns)
        return None if best is None else picture_of(best[1], self._channels, self._decoder, best[0])

    def _nearest(self, stamp_ns: int, within_ns: int) -> tuple[int, Message] | None:
        """Time [ns] and message of the nearest picture within a time."""
        log_ns, best = stamp_ns - self._offset_ns, None
        wider_ns = within_ns - SAME_TIME_NS
        for taken_ns, message in self._stamped(log_ns - _EARLY_NS - wider_ns):
            if message.log_ns > log_ns + _LATE_NS + wider_ns:
                break
            off_ns = abs(taken_ns - stamp_ns)
            if off_ns <= within_ns and (best is None or off_ns < abs(best[0] - stamp_ns)):
                best = taken_ns, message
        return best

    def _stamped(self, from_log_ns: int | None) -> Iterator[tuple[int, Message]]:
        """Messages with their times, in the order of writing."""
        for message in self._container.messages(self._numbers, from_log_ns, {}) if self._numbers else ():
            plain = replace(message, payload=plain_message(message.payload))
            stamp_ns = self._time_of(header_stamp(self._channels[message.channel], plain.payload), plain)
            if stamp_ns is not None:
                yield stamp_ns, plain
