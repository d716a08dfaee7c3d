"""A real server in its own process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections import deque
from pathlib import Path
from typing import Self

ROOT = Path(__file__).resolve().parents[2]
# Of a machine that is busy.
_PATIENCE_S = 120
_START = "import sys; from app.cli import main; sys.exit(main())"


class Server:
    """`stemmap serve SOURCE --no-browser`.

    Args:
        source: Sources that it opens, separated by spaces.
        port: 0 for any free one.
        token: Token of the link; empty for a new one.
        settings: Further variables of its environment.

    Attributes:
        link: The printed link.
        folder: Folder of its database and its recordings.
    """

    def __init__(self, source: str = "sim:stand", port: int = 0, token: str = "", **settings: str) -> None:
        self.folder = Path(settings.get("STEMMAP_FOLDER") or os.environ["STEMMAP_FOLDER"])
        self._log: deque[str] = deque(maxlen=50)
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START, "serve", *source.split(), "--no-browser", "--port", str(port)],
            cwd=ROOT,
            env={**os.environ, **({"STEMMAP_TOKEN": token} if token else {}), **settings},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.link = self._read_link()
        # A full pipe would stop the server.
        self._reader = threading.Thread(target=self._keep_reading, daemon=True)
        self._reader.start()

    @property
    def port(self) -> int:
        """Where it listens."""
        found = re.search(r":(\d+)/", self.link)
        assert found is not None
        return int(found.group(1))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End it as Ctrl-C does, and wait; once is enough."""
        if self._process.returncode is None:
            self._process.terminate()
            try:
                self._process.wait(timeout=_PATIENCE_S)
            finally:
                self._process.kill()
        self._reader.join(timeout=10)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def kill(self) -> None:
        """End it as kill -9 does; nothing is saved any more."""
        self._process.kill()
        self._process.wait(timeout=_PATIENCE_S)

    def _read_link(self) -> str:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._log.append(line)
            if found := re.search(r"http://\S+", line):
                return found.group(0)
        raise AssertionError("the server gave no link:\n" + "".join(self._log))

    def _keep_reading(self) -> None:
        assert self._process.stdout is not None
        self._log.extend(self._process.stdout)
