"""Decodes a picture from outside and writes it smaller, in a child process that may fail."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from typing import Any

#: Bytes of a JPEG.
LARGEST = 1 << 20
_PATIENCE_S = 60.0
#: -P: a folder that holds a file `app.py` must not decide what runs.
_DRAW = (sys.executable, "-P", "-m", "app.common.draw_picture")


def drawn(told: dict[str, object], data: bytes) -> bytes | None:
    """Return a picture as JPEG, or None if the child process fails, takes too long or returns too much.

    Args:
        told: Description of the picture, see `draw`.
        data: Encoded picture.
    """
    try:
        done = subprocess.run(
            _DRAW, input=json.dumps(told).encode() + b"\n" + data, capture_output=True, timeout=_PATIENCE_S,
            check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return None
    return done.stdout if done.returncode == 0 and 0 < len(done.stdout) <= LARGEST else None


PIXEL_LIMIT = 40_000_000
LARGEST_SIDE = 960
QUALITY = 80
_MODES = {"rgb8": ("RGB", "RGB", 3), "bgr8": ("RGB", "BGR", 3), "mono8": ("L", "L", 1),
          "rgba8": ("RGB", "RGBX", 4), "bgra8": ("RGB", "BGRX", 4)}  # fmt: skip


def draw(told: dict[str, Any], data: bytes) -> bytes:
    """Return a picture as JPEG, optionally with a box and a label.

    Args:
        told: encoding, width, height and step of raw pixels (encoding "" for an image file); optionally box
            (left, top, right, bottom [pixels]) and text.
        data: Encoded picture.

    Raises:
        ValueError: The picture is too large or has an unknown encoding.
        OSError: The picture is damaged.
    """
    from PIL import Image, ImageDraw

    Image.MAX_IMAGE_PIXELS = PIXEL_LIMIT
    if told["encoding"]:
        if told["encoding"] not in _MODES:
            raise ValueError("an encoding that is not known")
        mode, raw, _ = _MODES[told["encoding"]]
        size = (int(told["width"]), int(told["height"]))
        picture = Image.frombytes(mode, size, data, "raw", raw, int(told["step"]))
    else:
        picture = Image.open(io.BytesIO(data), formats=("JPEG", "PNG"))
        if picture.width * picture.height > PIXEL_LIMIT:
            raise ValueError("too many pixels")
        picture.load()
    picture = picture.convert("RGB")
    factor = min(1.0, LARGEST_SIDE / max(picture.size))
    if factor < 1.0:
        picture = picture.resize(
            (max(1, round(picture.width * factor)), max(1, round(picture.height * factor)))
        )
    if "box" in told:
        pen = ImageDraw.Draw(picture)
        left, top, right, bottom = (factor * float(side) for side in told["box"])
        pen.rectangle([left, top, max(right, left + 1), max(bottom, top + 1)], outline=(255, 208, 0), width=3)
        pen.text((left + 5, top + 4), str(told["text"])[:60], fill=(255, 208, 0))
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=QUALITY)
    return out.getvalue()


def main() -> None:
    """Read one picture, draw it and write the JPEG."""
    head, _, data = sys.stdin.buffer.read().partition(b"\n")
    try:
        drawn = draw(json.loads(head), data)
    except Exception as error:  # a decoder may raise any exception on damaged data
        print(f"{type(error).__name__}: {error}", file=sys.stderr)  # noqa: T201
        sys.exit(1)
    sys.stdout.buffer.write(drawn)


if __name__ == "__main__":
    main()
