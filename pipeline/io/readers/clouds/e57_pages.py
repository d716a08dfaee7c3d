"""The sums of the pages of an E57 file that libE57 stumbles over, checked before it does.

libE57 (3.x) checks them too, but does not give back what it took where it finds a damaged page while it opens
a station's points: 2 MB for each such file, in a process that may look at many. ASTM E2807, 6 and 9.
"""

from __future__ import annotations

import re
import struct
from functools import cache
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

PAGE = 1024
_SUMMED = PAGE - 4
#: signature, version, length of the file, place and length (without sums) of the XML, length of a page
_HEADER = struct.Struct("<8sIIQQQQ")
#: kind, seven bytes of nothing, length, place of the points, place of their index
_SECTION = struct.Struct("<B7xQQQ")
#: The XML of a scanner is some kB a station; more is not read into memory.
MOST_XML = 64 << 20
#: Of points; libE57 reads the first one at once: kind, flags, length - 1
_PACKET = struct.Struct("<2xH")
_AT_ONCE = 512  # pages
_POLYNOMIAL = 0x82F63B78  # CRC-32C (Castagnoli), reflected
# Element and attribute apart: in one expression a file without a ">" would be gone through once an attribute.
_POINTS = re.compile(rb"<points\b[^<>]*>")
_KIND = re.compile(rb"""\btype\s*=\s*["']CompressedVector["']""")
_PLACE = re.compile(rb"""fileOffset\s*=\s*["'](\d{1,18})["']""")


class Pages:
    """What stands in a file's header, and which of its pages are damaged.

    Args:
        path: Of the file.

    Attributes:
        damage: What is wrong with the header or the pages of the XML, "" where nothing is.
        sections: Where the points of each station begin, in their order; () where that is not understood.

    Raises:
        OSError: It cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._size = path, path.stat().st_size
        self.sections: tuple[int, ...] = ()
        with path.open("rb") as file:
            self.damage = self._look(file)

    def are_sound(self, station: int) -> bool:
        """Whether the pages where a station's points begin are whole, as far as it is known where that is."""
        if station >= len(self.sections):
            return True
        with self._path.open("rb") as file:
            section = self._read(file, self.sections[station], _SECTION.size)
            if section is None:
                return False
            _, _, points_at, _ = _SECTION.unpack(section)
            packet = self._read(file, points_at, _PACKET.size)
            if packet is None:
                return False
            return self._read(file, points_at, _PACKET.unpack(packet)[0] + 1) is not None

    def _look(self, file: BinaryIO) -> str:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size:
            return "it is cut within its header"
        _, _, _, length, xml_at, xml_length, page = _HEADER.unpack(head)
        if length != self._size:
            return f"it says that it has {length:,} bytes, and has {self._size:,}"
        if page != PAGE or self._size % PAGE:
            return "it does not consist of pages of 1024 bytes"
        if xml_length > MOST_XML:
            return f"its XML is larger than {MOST_XML >> 20} MB"
        xml = self._read(file, xml_at, xml_length)
        if xml is None or self._read(file, 0, _HEADER.size) is None:
            return "a checksum does not fit"
        points = [element for element in _POINTS.findall(xml) if _KIND.search(element)]
        places = [_PLACE.search(element) for element in points]
        self.sections = tuple(int(found[1]) for found in places if found is not None)
        return ""

    def _after(self, at: int) -> int:
        """How many bytes there are from a place on, without sums."""
        return max(0, (self._size // PAGE - at // PAGE) * _SUMMED - at % PAGE)

    def _read(self, file: BinaryIO, at: int, length: int) -> bytes | None:
        """The bytes at a place of the file, without sums; None where their pages are damaged or not there."""
        first, within = divmod(at, PAGE)
        pages, parts = -(-(within + length) // _SUMMED), []
        if within > _SUMMED or length > self._after(at):
            return None
        file.seek(first * PAGE)
        for k in range(0, pages, _AT_ONCE):
            content = file.read(min(_AT_ONCE, pages - k) * PAGE)
            rows = np.frombuffer(content[: len(content) // PAGE * PAGE], np.uint8).reshape(-1, PAGE)
            told = np.ascontiguousarray(rows[:, _SUMMED:]).view(">u4")[:, 0]
            if len(content) % PAGE or not (checksums(rows[:, :_SUMMED]) == told).all():
                return None
            parts.append(rows[:, :_SUMMED].tobytes())
        return b"".join(parts)[within : within + length]


def checksums(rows: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """CRC-32C of each row, shape (N, length >= 4): it is linear, so each byte adds what its place tells."""
    length = rows.shape[1]
    begun = rows.copy()
    begun[:, :4] ^= 0xFF  # the same as to begin with ones
    added: NDArray[np.uint32] = np.bitwise_xor.reduce(_at_places(length)[np.arange(length), begun], axis=1)
    return ~added


@cache
def _at_places(length: int) -> NDArray[np.uint32]:
    """What each of 256 bytes adds at each place, shape (length, 256)."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(_POLYNOMIAL), table >> 1).astype(np.uint32)
    added = [table]
    for _ in range(length - 1):
        added.append(table[added[-1] & 0xFF] ^ (added[-1] >> np.uint32(8)))
    return np.stack(added[::-1])
