"""Uploaded recordings: streamed into the data folder, and kept only if they can be read."""

from __future__ import annotations

import asyncio
import contextlib
import re
import secrets
import shutil
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import msgspec
from fastapi import APIRouter, Query, Request
from starlette.requests import ClientDisconnect
from starlette.responses import Response

from app.sources import opening
from app.store.async_store import AsyncStore
from app.web.auth import UPLOADS
from app.web.responses import json_reply
from pipeline.errors import StemmapError

# Free disk space that is reserved for the system and for annotations.
SPARE_BYTES = 1 << 30
MOST_AT_ONCE = 2
_CHUNK = 4 << 20
_STALLED_S = 60.0
# An incomplete file that has not been written for this long belongs to a terminated server.
_ABANDONED_S = 3600.0
_PART = ".upload-"
_SUFFIX = re.compile(r"\.[a-z0-9]{1,8}\Z")
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]+")  # letters of other names, dots and separators
# A drive of KITTI has 4,541 scans; their list takes 0.2 MB.
_MOST_FILES, _LONGEST_LIST, _DEEPEST = 20_000, 4 << 20, 4
_LONGEST_NAME = 60  # 240 bytes in UTF-8, below the 255 of file systems


class UploadError(StemmapError):
    """An upload that is refused and removed; `status` is the HTTP status of the response."""

    def __init__(self, status: int, what: str, *, where: str = "", remedy: str = "") -> None:
        super().__init__(what, where=where, remedy=remedy)
        self.status = status


class Uploads:
    """Stores uploads in a folder.

    Args:
        folder: The folder, created with the first upload; None refuses uploads.
        limit: Maximum size of a file [bytes].
        store: Access to the store, which records the original names.
    """

    def __init__(self, folder: Path | None, limit: int, store: AsyncStore) -> None:
        self._folder, self.limit, self._store = folder, limit, store
        self._under_way = 0
        self._awaited = 0  # bytes that active uploads have not written yet

    def room(self) -> int:
        """Return the maximum size of an upload at present [bytes]: the limit or the free disk space without a
        reserve, at least 0. The folder is created.

        Raises:
            UploadError: There is no folder for uploads, or it cannot be created.
        """
        return self._room(self._free())

    async def take(
        self, name: str, size: int, stream: AsyncIterator[bytes], *, many: bool = False
    ) -> dict[str, Any]:
        """Receive a file, or the files of one recording as a folder, and check it in a child process. It gets
        a generated name; a refused upload is removed. Return a dict with the path (`uri`), the original name
        (`name`), the format (`kind`) and the size in bytes (`bytes`).

        Args:
            name: Original name of the file or folder.
            size: Announced size [bytes].
            stream: Yields the bytes.
            many: Whether they are those of several files, after a line with their list, see `_file_list`.

        Raises:
            UploadError: MOST_AT_ONCE uploads are in progress; or the file is empty, too large, incomplete,
                stalled, cannot be stored, or cannot be read as a recording.
        """
        if self._under_way >= MOST_AT_ONCE:
            raise UploadError(409, f"{MOST_AT_ONCE} uploads are under way", remedy="Wait until one is done")
        self._under_way += 1
        try:
            return await self._take(name, size, stream, many)
        finally:
            self._under_way -= 1

    async def _take(self, name: str, size: int, stream: AsyncIterator[bytes], many: bool) -> dict[str, Any]:
        """Receive a file or a folder; results and errors as in `take`, without the limit of simultaneous
        uploads."""
        free = await asyncio.to_thread(self._free)
        room = self._room(free)  # without an await in between, other uploads cannot take the same space
        if size > room:
            why = "the limit" if size > self.limit else "what the disk has free"
            raise UploadError(
                413, f"the file has {_gigabytes(size)}, more than {why}: {_gigabytes(room)}", where=name
            )
        if size <= 0:
            raise UploadError(422, "the file is empty", where=name)
        # Readers inspect the contents first, but a file of plain floats is recognised only by its name.
        suffix = Path(name).suffix.lower()
        suffix = suffix if _SUFFIX.match(suffix) and not many else ""
        part = self._place() / f"{_PART}{secrets.token_hex(8)}{suffix}"
        try:
            await self._write(part, size, stream, many)
            kind = await _look_at(part, name)
            stem = _UNSAFE.sub("_", Path(_shown(name)).stem)[:_LONGEST_NAME]  # files and reports name it
            made_up = f"upload-{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}-{stem}{suffix}"
            place = part.with_name(made_up)
            part.rename(place)
        except OSError as error:
            raise UploadError(507, f"the file cannot be kept: {error.strerror}", where=name) from None
        finally:
            _remove(part)
        with contextlib.suppress(StemmapError):  # it is then listed under its generated name
            await self._store.ask(lambda store: store.book.add_upload(made_up, _shown(name), kind, size))
        return {"uri": str(place), "name": _shown(name), "kind": kind, "bytes": size}

    def _free(self) -> int:
        """Return the free disk space without SPARE_BYTES [bytes]; may be negative. Errors as `_place`."""
        return shutil.disk_usage(self._place()).free - SPARE_BYTES

    def _room(self, free: int) -> int:
        """Return the maximum size of an upload with a free disk space, see `_free` [bytes]."""
        return max(0, min(self.limit, free - self._awaited))

    async def _write(self, part: Path, size: int, stream: AsyncIterator[bytes], many: bool) -> None:
        """Write the file or the folder, and reserve the space that is not written yet against other uploads.
        Arguments and errors as in `take`."""
        awaited = size

        def wrote(length: int) -> None:
            nonlocal awaited
            awaited -= length
            self._awaited -= length

        self._awaited += size
        try:
            await (_write_folder if many else _write)(part, size, _in_time(stream), wrote)
        finally:
            self._awaited -= awaited

    def clear(self) -> None:
        """Remove incomplete uploads of which nothing was written for an hour: those of servers that were
        terminated."""
        if self._folder is None or not self._folder.is_dir():
            return
        for part in self._folder.glob(f"{_PART}*"):
            with contextlib.suppress(OSError):
                written = max(path.stat().st_mtime for path in (part, *part.rglob("*")))
                if written < time.time() - _ABANDONED_S:
                    _remove(part)

    def _place(self) -> Path:
        """Return the folder, which is created if necessary; raises UploadError if there is none or it cannot
        be created."""
        if self._folder is None:
            raise UploadError(409, "there is no folder for uploads", remedy="Name one with STEMMAP_FOLDER")
        try:
            self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        except OSError as error:
            raise UploadError(
                507, f"the folder for uploads cannot be made: {error.strerror}", where=str(self._folder)
            ) from None
        return self._folder


def _remove(part: Path) -> None:
    """Remove an incomplete file or folder; nothing if it does not exist."""
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    else:
        part.unlink(missing_ok=True)


async def _write_folder(
    part: Path, size: int, stream: AsyncIterator[bytes], wrote: Callable[[int], None]
) -> None:
    """Write the files of a folder, which follow one another in the stream after their list; the folder is
    created. Arguments and errors as `_write`, and those of `_file_list`; UploadError also if the sizes do not
    add up to `size`."""
    pieces, rest = aiter(stream), b""
    while b"\n" not in rest and len(rest) < _LONGEST_LIST and (piece := await anext(pieces, b"")):
        rest += piece
    line, _, rest = rest.partition(b"\n")
    files = _file_list(line)
    if len(line) + 1 + sum(length for _, length in files) != size:
        raise UploadError(422, "the sizes of the files are not that of the upload")

    async def next_file(length: int) -> AsyncIterator[bytes]:
        nonlocal rest
        while length > 0 and (piece := rest or await anext(pieces, b"")):
            head, rest = piece[:length], piece[length:]
            length -= len(head)
            yield head

    part.mkdir()
    for path, length in files:
        place = part / path
        place.parent.mkdir(parents=True, exist_ok=True)
        await _write(place, length, next_file(length), wrote)


def _file_list(line: bytes) -> list[tuple[PurePosixPath, int]]:
    """Return (path in the folder, size [bytes]) of each file of an upload, in the order of the list.

    Args:
        line: JSON, a list of [path, size].

    Raises:
        UploadError: The value is not such a list, has no or too many files, two of one path, one in the path
            of another, or a path that leaves the folder, is hidden, too deep or too long.
    """
    try:
        listed = msgspec.json.decode(line, type=list[tuple[str, Annotated[int, msgspec.Meta(ge=0)]]])
    except msgspec.DecodeError:
        raise UploadError(422, "the list of the files cannot be read") from None
    if not 0 < len(listed) <= _MOST_FILES:
        raise UploadError(
            422, f"{len(listed):,} files are not one recording", remedy=f"Upload 1 to {_MOST_FILES:,} files"
        )
    for name, _ in listed:
        parts = name.split("/")
        if len(parts) > _DEEPEST or not all(map(_is_file_name, parts)):
            raise UploadError(422, "a file has a name that cannot be used", where=_shown(name))
    files = {PurePosixPath(name): size for name, size in listed}
    if len(files) != len(listed) or any(folder in files for path in files for folder in path.parents):
        raise UploadError(422, "two files, or a file and a folder, have the same name")
    return list(files.items())


def _is_file_name(name: str) -> bool:
    """Return whether a file or folder of an upload may have this name: not hidden, empty, too long, or with
    characters that are not printed or separate folders."""
    return (
        name.isprintable()
        and not name.startswith(".")
        and "\\" not in name
        and 0 < len(name) <= _LONGEST_NAME
    )


async def _write(part: Path, size: int, stream: AsyncIterator[bytes], wrote: Callable[[int], None]) -> None:
    """Write the file in large blocks, each in a thread.

    Args:
        part: File to write; it must not exist.
        size: Announced length [bytes].
        stream: Yields the bytes.
        wrote: Called with the length of each block but the last.

    Raises:
        UploadError: The browser disconnected, or sent another length than announced. What has been written
            remains.
        OSError: The file exists or cannot be written.
    """
    written, waiting = 0, bytearray()
    # Not in a thread: a cancelled request would not notice the file that is created afterwards.
    file = part.open("xb")
    try:
        async for piece in stream:
            waiting += piece
            if len(waiting) >= _CHUNK:
                written += len(waiting)
                await asyncio.to_thread(file.write, bytes(waiting))
                wrote(len(waiting))
                waiting.clear()
        written += len(waiting)
        await asyncio.to_thread(file.write, bytes(waiting))
    finally:
        file.close()
    if written != size:
        raise UploadError(422, f"only {written} of {size} bytes arrived", remedy="Upload the file again")


async def _in_time(stream: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """Yield the pieces of a stream; raises UploadError (408) if none arrives for `_STALLED_S`."""
    pieces = aiter(stream)
    while True:
        try:
            yield await asyncio.wait_for(anext(pieces), _STALLED_S)
        except StopAsyncIteration:
            return
        except TimeoutError:
            raise UploadError(
                408, f"no data arrived for {_STALLED_S:.0f} s", remedy="Upload it again"
            ) from None


async def _look_at(part: Path, name: str) -> str:
    """Return the name of the format of the file, detected in a child process; "not looked through yet" if
    that takes too long.

    Args:
        part: The incomplete file.
        name: Original name of the file, for errors.

    Raises:
        UploadError: The file cannot be read.
    """
    try:
        found = await opening.ask({"ask": "recording", "path": str(part)})
    except opening.TookTooLongError:
        return "not looked through yet"  # a very large file; errors appear when it is opened
    except StemmapError as error:
        # The path is that of the incomplete file; the person knows the original name.
        what, remedy = (text.replace(str(part), name) for text in (error.what, error.remedy))
        raise UploadError(422, what, where=_shown(name), remedy=remedy) from None
    return str(found["kind"])


def _shown(name: str) -> str:
    """Return the name without folders and control characters, cut to 200 characters; "recording" if it is
    empty."""
    last = name.replace("\\", "/").rpartition("/")[2]
    return "".join(letter for letter in last if letter.isprintable())[:200] or "recording"


def _gigabytes(size: int) -> str:
    """Return a size [bytes] as text in GB, or in MB below 0.1 GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e8 else f"{size / 1e6:.1f} MB"


router = APIRouter()


@router.get(UPLOADS)
async def room(request: Request) -> Response:
    """GET /api/uploads: return `room`, the maximum size of an upload at present, and `limit`, that of any
    upload [bytes], so that a browser does not send one that is refused. 409 or 507 without a usable folder.
    """
    uploads: Uploads = request.app.state.uploads
    return json_reply({"room": await asyncio.to_thread(uploads.room), "limit": uploads.limit})


@router.post(UPLOADS)
async def upload(
    request: Request, name: Annotated[str, Query(min_length=1, max_length=1000)], many: bool = False
) -> Response:
    """POST /api/uploads: store a recording, whose bytes are the body of the request, under its name; with
    `many` those of several files after their list (see `_file_list`). Return how it is stored (see
    `Uploads.take`), with 201. An error, as JSON, for another type than
    application/octet-stream (422), without a length (411), and where the file cannot be stored."""
    uploads: Uploads = request.app.state.uploads
    kind = request.headers.get("content-type", "")
    if kind != "application/octet-stream":  # what a form of another page cannot send
        raise UploadError(
            422, "the body must be the file", where="Content-Type", remedy="Send application/octet-stream"
        )
    size = request.headers.get("content-length", "")
    if not size.isdecimal():
        raise UploadError(411, "the length of the file is missing", where="Content-Length")
    return json_reply(await uploads.take(name, int(size), _pieces(request), many=many), 201)


async def _pieces(request: Request) -> AsyncIterator[bytes]:
    """Yield the body of a request; raises UploadError if the browser disconnects."""
    try:
        async for piece in request.stream():
            yield piece
    except ClientDisconnect:
        raise UploadError(422, "the connection ended before the file was complete") from None
