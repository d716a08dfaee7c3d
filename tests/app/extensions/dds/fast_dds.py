"""The independent peer on plain DDS: Fast DDS of Debian's packages, which sends what a recording holds."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from pipeline.io.readers.container import Message
from pipeline.io.readers.mcap_file import McapFile
from pipeline.io.readers.topics import POINT_CLOUD

PEER = Path(__file__).parent / "fastdds" / "peer.cpp"


def compiled(folder: Path) -> Path:
    """The peer, compiled against Debian's libfastrtps-dev; skips the test where that is not there."""
    compiler = shutil.which("c++")
    if compiler is None or not Path("/usr/include/fastdds").is_dir():
        pytest.skip("no C++ compiler, or Debian's libfastrtps-dev is not installed")
    made = folder / "peer"
    words = [compiler, "-std=c++17", str(PEER), "-o", str(made), "-lfastrtps", "-lfastcdr", "-lpthread"]
    subprocess.run(words, check=True)
    return made


def messages_of(run: Path, *, one_each: bool = False) -> Iterator[tuple[str, str, bytes]]:
    """Topic, type and CDR of the messages of a recording."""
    with closing(McapFile(run)) as container:
        channels = {c.number: c for c in container.channels}
        left = set(channels)
        message: Message
        for message in container.messages(list(channels), None, {}):
            if message.channel in left or not one_each:
                left.discard(message.channel)
                yield channels[message.channel].topic, channels[message.channel].msgtype, message.payload


class Peer:
    """The publisher of Fast DDS: `tests/app/extensions/dds/fastdds/peer.cpp` says what its lines mean.

    Args:
        program: See `compiled`.
        domain: Of DDS.
        run: A recording, whose messages it sends.
    """

    def __init__(self, program: Path, domain: int, run: Path) -> None:
        self.messages = list(messages_of(run))
        self._numbers = {topic: k for k, topic in enumerate(dict.fromkeys(m[0] for m in self.messages))}
        self._process = subprocess.Popen(
            [str(program), str(domain)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    def announce(self, *, reliable: bool, topics: tuple[str, ...] = ()) -> None:
        """Make the writers of some topics, or of all."""
        for topic, number in self._numbers.items():
            msgtype = next(m[1] for m in self.messages if m[0] == topic)
            package, _, name = msgtype.split("/")
            latched = int(topic.endswith("tf_static"))
            sure = int(reliable or latched)
            if not topics or topic in topics:
                self._say(f"W {number} rt{topic} {package}::msg::dds_::{name}_ {sure} {latched}\n".encode())
        self.finish()

    def withdraw(self, topic: str) -> None:
        """Delete a writer."""
        self._say(f"D {self._numbers[topic]}\n".encode())
        self.finish()

    def send(self, pause_us: int = 0) -> None:
        """Send all messages."""
        for topic, msgtype, payload in self.messages:
            pause = pause_us if msgtype == POINT_CLOUD else 0
            self._say(f"M {self._numbers[topic]} {len(payload)} {pause}\n".encode() + payload)
        self.finish()

    def matched(self, topic: str) -> None:
        """Wait until somebody listens to a topic."""
        self._say(f"A {self._numbers[topic]}\n".encode())
        self.finish()

    def finish(self) -> None:
        """Wait until all that was said is done."""
        self._say(b"P\n")
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b"done\n"

    def close(self) -> None:
        self._process.kill()
        self._process.wait(30)
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            stream.close()

    def _say(self, line: bytes) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line)
        self._process.stdin.flush()
