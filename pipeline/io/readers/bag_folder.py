"""A folder that a ROS 2 recorder wrote: metadata.yaml beside one or more .mcap or .db3 files."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

from pipeline.errors import SourceError
from pipeline.io.readers.container import Channel, Container, Message, count_loss
from pipeline.io.readers.db3_file import open_db3
from pipeline.io.readers.mcap_file import open_mcap

_OPENERS: dict[str, Callable[[Path], Container]] = {".mcap": open_mcap, ".db3": open_db3}
#: Channels of the n-th file get numbers from n times this on.
_STRIDE = 1 << 40


def bag_files(folder: Path) -> list[Path]:
    """The .mcap and .db3 files of a folder, by name.

    Raises:
        SourceError: They are compressed as a whole, or are several without metadata.yaml.
    """
    files = sorted((path for path in folder.iterdir() if path.suffix in _OPENERS), key=_natural)
    packed = sorted(path for path in folder.iterdir() if path.suffixes[-1:] == [".zstd"])
    if packed and not files:
        raise SourceError(
            "the files of the recording are compressed",
            where=str(packed[0]),
            remedy="Unpack them with zstd -d.",
        )
    if len(files) > 1 and not (folder / "metadata.yaml").is_file():
        raise SourceError(
            f"the folder holds {len(files)} recordings without metadata.yaml",
            where=str(folder),
            remedy="Name one of the files.",
        )
    return files


def _natural(path: Path) -> tuple[int, str]:
    """Recorders number the parts ..._0, ..._1, ..., ..._10."""
    tail = path.stem.rpartition("_")[2]
    return (int(tail), path.name) if tail.isdecimal() and len(tail) < 10 else (0, path.name)


class BagFolder:
    """Several files as one container of messages.

    Args:
        files: In the order of recording.

    Raises:
        SourceError: None of them can be read.
    """

    def __init__(self, files: list[Path]) -> None:
        self.damage: dict[str, int] = {}
        self._parts: list[Container] = []
        for path in files:
            try:
                self._parts.append(_OPENERS[path.suffix](path))
            except SourceError:
                if len(files) == 1:
                    raise
                count_loss(self.damage, "files of the recording that cannot be read")
        if not self._parts:
            raise SourceError("none of the files of the recording can be read", where=str(files[0].parent))
        for part in self._parts:
            for reason, count in part.damage.items():
                count_loss(self.damage, reason, count)

    @property
    def kind(self) -> str:
        """The format in words."""
        return self._parts[0].kind

    @property
    def channels(self) -> list[Channel]:
        """The channels of all files, with numbers of their own."""
        return [
            replace(channel, number=channel.number + _STRIDE * index)
            for index, part in enumerate(self._parts)
            for channel in part.channels
        ]

    def tail_ns(self, numbers: Collection[int]) -> int:
        """See Container."""
        return max(part.tail_ns(_own(numbers, index)) for index, part in enumerate(self._parts))

    def messages(
        self, numbers: Collection[int], start_ns: int | None, losses: dict[str, int]
    ) -> Iterator[Message]:
        """See Container."""
        streams = [
            _renumbered(part.messages(_own(numbers, index), start_ns, losses), index)
            for index, part in enumerate(self._parts)
        ]
        return heapq.merge(*streams, key=attrgetter("log_ns"))

    def attachment(self, name: str, limit: int) -> bytes | None:
        """See Container."""
        found = (part.attachment(name, limit) for part in self._parts)
        return next((content for content in found if content is not None), None)

    def close(self) -> None:
        """Close all files."""
        for part in self._parts:
            part.close()


def _own(numbers: Collection[int], index: int) -> list[int]:
    return [number - _STRIDE * index for number in numbers if number // _STRIDE == index]


def _renumbered(messages: Iterator[Message], index: int) -> Iterator[Message]:
    if index == 0:
        return messages
    return (replace(message, channel=message.channel + _STRIDE * index) for message in messages)
