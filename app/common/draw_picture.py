"""Has a picture from outside decoded and written smaller, by a process that may die of it."""

from __future__ import annotations

import json
import subprocess
import sys

#: Bytes of a JPEG.
LARGEST = 1 << 20
_PATIENCE_S = 60.0
#: -P: a folder that holds a file `app.py` must not decide what runs.
_DRAW = (sys.executable, "-P", "-m", "app.common.draw_picture_process")


def drawn(told: dict[str, object], data: bytes) -> bytes | None:
    """The JPEG, None where the process that decodes it dies, takes too long or says too much.

    Args:
        told: See `app.common.draw_picture_process.draw`.
        data: The picture.
    """
    try:
        done = subprocess.run(
            _DRAW, input=json.dumps(told).encode() + b"\n" + data, capture_output=True, timeout=_PATIENCE_S,
            check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return None
    return done.stdout if done.returncode == 0 and 0 < len(done.stdout) <= LARGEST else None
