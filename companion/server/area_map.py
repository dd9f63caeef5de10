"""The map below the plan view: a PMTiles file of the user, served by byte ranges.

Format: PMTiles, version 3 (github.com/protomaps/PMTiles). The file's path comes from the node's own
settings, never from a recording: the author of a recording must not choose which files are served.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from fastapi import FastAPI, HTTPException
from fastapi.responses import Response

from companion.mavlink.links.regular_file import open_regular
from companion.server.byte_ranges import Range, file_answer, file_answers
from companion.server.responses import answer, answers
from companion.server.threads import in_file_thread
from companion.values import UserError
from companion.values.described import Meaning

MAGIC: Final = b"PMTiles\x03"
MEDIA_TYPE: Final = "application/vnd.pmtiles"


@dataclass(frozen=True, slots=True)
class AreaMap:
    """Map under the plan view of the page."""

    name: Annotated[str | None, Meaning("name of the map's file; null without one")]


def find(named: str | None) -> Path | None:
    """Return the map file of ``[page] map``. Raises ``UserError`` if it is not PMTiles."""
    if named is None:
        return None
    try:
        with open_regular(Path(named)) as file:
            head = file.read(len(MAGIC))
    except OSError as error:
        raise UserError(f"page.map = {named!r}: {error.strerror}") from error
    if head != MAGIC:
        raise UserError(f"page.map = {named!r}: not a PMTiles file, version 3; convert it")
    return Path(named)


def add(app: FastAPI, file: Path | None) -> None:
    """Add the routes of the map to the application."""

    @app.get(
        "/v1/map",
        summary="The map under the plan view, if the settings name one",
        responses=answers(AreaMap),
    )
    async def area_map() -> Response:
        return answer({"name": None if file is None else file.name})

    @app.get(
        "/v1/map/tiles",
        summary="Tiles of the map, by Range",
        response_class=Response,
        responses=file_answers(MEDIA_TYPE),
    )
    async def tiles(wanted: Range) -> Response:
        if file is None:
            raise HTTPException(404, "no map; name one in [page] map")
        try:
            found = await in_file_thread(open_regular, file)
        except OSError as error:
            raise HTTPException(404, f"the map cannot be read: {error.strerror}") from error
        status = os.fstat(found.fileno())
        # A page that reads parts of two files learns from the tag that they do not belong together.
        headers = {"etag": f'"{status.st_mtime_ns:x}-{status.st_size:x}"'}
        return file_answer(
            found, status.st_size, wanted=wanted, media_type=MEDIA_TYPE, headers=headers
        )
