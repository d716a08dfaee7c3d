"""Decodes a picture from outside and encodes it smaller, in a child process that may fail."""

from __future__ import annotations

import io
import sys
from typing import TYPE_CHECKING

import msgspec

from app.common.child_process import (
    BlockingChildProcess,
    ChildError,
    ParentConnection,
    ProtocolError,
    python_module,
    run_child,
)

if TYPE_CHECKING:
    from pipeline.types.camera import Picture

_COMMAND = python_module("app.common.draw_picture")
_LINE_LIMIT = 2 << 20  # of a JPEG in base 64 [bytes]
_PATIENCE_S = 60.0
PIXEL_LIMIT = 40_000_000
LARGEST_SIDE = 960
QUALITY = 80
# Mode of Pillow, and its name of the raw pixels, by ROS encoding.
_MODES = {
    "rgb8": ("RGB", "RGB"),
    "bgr8": ("RGB", "BGR"),
    "mono8": ("L", "L"),
    "rgba8": ("RGB", "RGBX"),
    "bgra8": ("RGB", "BGRX"),
}
_YELLOW = (255, 208, 0)


class Drawing(msgspec.Struct, frozen=True):
    """A picture to be drawn. The child process does not import the readers, which would take longer than to
    draw.

    Attributes:
        encoding, width, height, step, data: As in `Picture`.
        box: Left, top, right, bottom of a frame [pixels]; None draws none.
        text: Label of the box.
        region: Left, top, right, bottom of the part that is drawn [pixels]; None draws all.
    """

    encoding: str
    width: int
    height: int
    step: int
    data: bytes
    box: tuple[float, float, float, float] | None = None
    text: str = ""
    region: tuple[float, float, float, float] | None = None

    @classmethod
    def of(
        cls,
        picture: Picture,
        box: tuple[float, float, float, float] | None = None,
        text: str = "",
        region: tuple[float, float, float, float] | None = None,
    ) -> Drawing:
        """Return the drawing of a picture of a camera.

        Args:
            picture: The picture.
            box, text, region: As in `Drawing`.
        """
        raw = (picture.encoding, picture.width, picture.height, picture.step, picture.data)
        return cls(*raw, box, text, region)


def draw_safely(drawing: Drawing) -> bytes | None:
    """Return a picture as JPEG, see `draw`, made in a child process; None if that fails, takes more than 60 s
    or returns more than 2 MB.

    Raises:
        StemmapError: No process can be started.
    """
    child = BlockingChildProcess(_COMMAND, line_limit=_LINE_LIMIT)
    try:
        child.send(drawing)
        return child.receive(bytes, _PATIENCE_S)
    except (ChildError, ProtocolError):
        return None
    finally:
        child.end()


def draw(drawing: Drawing) -> bytes:
    """Return a picture as JPEG, never enlarged and at most `LARGEST_SIDE` pixels wide and high, with its box
    and the first 60 characters of its label if it has a box. Pillow's limit of pixels is changed for the
    whole process.

    Raises:
        ValueError: The encoding is unknown, raw data are too short, or an encoded picture has more than
            PIXEL_LIMIT pixels.
        OSError: The picture is damaged. A damaged picture can raise any other exception of Pillow as well.
    """
    from PIL import Image, ImageDraw

    Image.MAX_IMAGE_PIXELS = PIXEL_LIMIT
    if drawing.encoding:
        if drawing.encoding not in _MODES:
            raise ValueError("an encoding that is not known")
        mode, raw = _MODES[drawing.encoding]
        picture = Image.frombytes(
            mode, (drawing.width, drawing.height), drawing.data, "raw", raw, drawing.step
        )
    else:
        picture = Image.open(io.BytesIO(drawing.data), formats=("JPEG", "PNG"))
        if picture.width * picture.height > PIXEL_LIMIT:
            raise ValueError("too many pixels")
        picture.load()
    picture = picture.convert("RGB")
    corner = (0.0, 0.0)
    if drawing.region is not None:
        corner = drawing.region[:2]
        picture = picture.crop(drawing.region)
    factor = min(1.0, LARGEST_SIDE / max(picture.size))
    if factor < 1.0:
        picture = picture.resize(
            (max(1, round(picture.width * factor)), max(1, round(picture.height * factor)))
        )
    if drawing.box is not None:
        pen = ImageDraw.Draw(picture)
        left, top, right, bottom = (
            factor * (side - at) for side, at in zip(drawing.box, corner * 2, strict=True)
        )
        pen.rectangle([left, top, max(right, left + 1), max(bottom, top + 1)], outline=_YELLOW, width=3)
        pen.text((left + 5, top + 4), drawing.text[:60], fill=_YELLOW)
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=QUALITY)
    return out.getvalue()


def _answer(parent: ParentConnection) -> None:
    """Draw one picture and send it; raises SystemExit if it cannot be drawn."""
    try:
        picture = draw(parent.receive(Drawing))
    except Exception as error:  # a decoder may raise any exception on damaged data
        sys.exit(f"{type(error).__name__}: {error}")
    parent.send(picture)


if __name__ == "__main__":
    run_child(_answer)
