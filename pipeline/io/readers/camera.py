"""Pictures of a recording's camera, and where things of the map stand in them; nothing is decoded here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from typing import cast

import numpy as np

from pipeline.geometry.poses import Float, Pose3
from pipeline.io.readers import ros_messages
from pipeline.io.readers.container import Channel, Container, Message
from pipeline.io.readers.decompression import plain_message
from pipeline.io.readers.rostypes import CAMERA_INFO, COMPRESSED_IMAGE, MessageDecoder
from pipeline.io.readers.tf_tree import TransformTree, frame_name
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
