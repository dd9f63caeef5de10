"""Answers with the bytes of a file, whole or the part that ``Range`` names (RFC 9110, 14).

Files are read on threads, a piece at a time, as fast as the client takes them.
"""

import re
from collections.abc import AsyncIterator
from typing import Annotated, Any, BinaryIO, Final

from fastapi import Depends, Header, HTTPException
from fastapi.responses import StreamingResponse

from companion.server.connections import CutShortError
from companion.server.responses import refusals
from companion.server.threads import in_file_thread

_RANGE: Final = re.compile(r"bytes=(\d{0,18})-(\d{0,18})", re.ASCII)
PIECE_BYTES: Final = 65_536  # read at a time, and held for a client that takes nothing


def _wanted(
    wanted: Annotated[str | None, Header(alias="range", description="bytes=FIRST-LAST")] = None,
    unchanged: Annotated[
        str | None, Header(alias="if-range", description="if given, Range is ignored")
    ] = None,
) -> str | None:
    """Return the Range header; None beside If-Range: these answers have no validator to match."""
    return None if unchanged is not None else wanted


Range = Annotated[str | None, Depends(_wanted)]


class UnsatisfiableRangeError(ValueError):
    """Error of a byte range that begins beyond the end of the file."""


def file_answer(
    file: BinaryIO, size: int, *, wanted: str | None, media_type: str, headers: dict[str, str]
) -> StreamingResponse:
    """Return the answer with the first ``size`` bytes of an open file, or the part of ``wanted``.

    ``wanted`` is a Range header. The file is closed with the answer. Raises ``HTTPException`` 416
    for a range beyond the end.
    """
    try:
        part = span(wanted, size)
    except UnsatisfiableRangeError as error:
        file.close()
        raise HTTPException(416, str(error), {"content-range": f"bytes */{size}"}) from error
    start, stop = part or (0, size)
    headers = {**headers, "accept-ranges": "bytes", "content-length": str(stop - start)}
    if part is not None:
        headers["content-range"] = f"bytes {start}-{stop - 1}/{size}"
    return StreamingResponse(
        _pieces(file, start, stop),
        status_code=200 if part is None else 206,
        headers=headers,
        media_type=media_type,
    )


def file_answers(media_type: str) -> dict[int | str, dict[str, Any]]:
    """Return the responses of an operation that answers with a file, for the OpenAPI document."""
    content: dict[str, Any] = {"content": {media_type: {}}}
    return {
        200: content,
        206: content | {"description": "The bytes of Range"},
        **refusals(404, 416, 422),
    }


def span(header: str | None, size: int) -> tuple[int, int] | None:
    """Return a Range header's first byte and the byte after its last; None for the whole file.

    RFC 9110, 14.2: a malformed header, or one with several ranges, may be ignored. Raises
    ``UnsatisfiableRangeError`` for a range beyond the end.
    """
    found = _RANGE.fullmatch((header or "").replace(" ", ""))
    if found is None or not (found[1] or found[2]):
        return None
    if not found[1]:
        start, stop = max(0, size - int(found[2])), size
    else:
        start, stop = int(found[1]), min(size, int(found[2]) + 1 if found[2] else size)
        if found[2] and int(found[2]) < int(found[1]):
            return None
    if start >= size or start >= stop:
        raise UnsatisfiableRangeError(f"the file has {size} bytes")
    return start, stop


async def _pieces(file: BinaryIO, start: int, stop: int) -> AsyncIterator[bytes]:
    """Yield a file's bytes from ``start`` to ``stop``, off the event loop; close the file.

    Raises ``CutShortError`` if the file has become shorter.
    """
    with file:
        await in_file_thread(file.seek, start)
        while start < stop:
            piece = await in_file_thread(file.read, min(PIECE_BYTES, stop - start))
            if not piece:
                raise CutShortError
            start += len(piece)
            yield piece
