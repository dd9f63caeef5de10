"""A user's map under the plan view: at the right position, loaded from this server only."""

import io
import math
import re
import struct
import subprocess
import zlib
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import write
from support import BIN, HANG_S, line_of, started

pytestmark = pytest.mark.full
CARRIER = (47.3977419, 8.5455938)
GROUND, MARK = (40, 160, 60), (250, 30, 30)


def picture(marked: tuple[float, float] | None) -> bytes:
    """Return a plain PNG tile with a square around the marked pixel."""
    rows = bytearray()
    for y in range(256):
        rows.append(0)  # no filter
        for x in range(256):
            near = marked and max(abs(x - marked[0]), abs(y - marked[1])) < 8
            rows += bytes(MARK if near else GROUND)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", 256, 256, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


@pytest.fixture
def area(tmp_path: Path) -> Path:
    """Return one zoom level around the carrier, whose position is marked. Web Mercator tiles."""
    path, zoom = tmp_path / "area.pmtiles", 16
    world = 2**zoom
    x = (CARRIER[1] + 180) / 360 * world
    y = (1 - math.asinh(math.tan(math.radians(CARRIER[0]))) / math.pi) / 2 * world
    tiles = {}
    for column in range(int(x) - 2, int(x) + 3):
        for row in range(int(y) - 2, int(y) + 3):
            own = (column, row) == (int(x), int(y))
            tiles[zxy_to_tileid(zoom, column, row)] = picture(
                ((x - column) * 256, (y - row) * 256) if own else None
            )
    corners = {"min_lon_e7": 80000000, "min_lat_e7": 470000000}
    corners |= {"max_lon_e7": 90000000, "max_lat_e7": 480000000}
    with write(str(path)) as archive:
        for number, tile in sorted(tiles.items()):
            archive.write_tile(number, tile)
        kind = {"tile_type": TileType.PNG, "tile_compression": Compression.NONE}
        archive.finalize(kind | corners, {"attribution": "<a href='x'>made up</a>"})
    return path


def reddish(page: Any, right: int, down: int) -> bool:
    """Return whether the map has the mark's colour at an offset from its centre, the carrier.

    Tiles are drawn at about half opacity over the page's background.
    """
    box = page.locator("#ground").bounding_box()
    at = {"x": box["x"] + box["width"] / 2 + right, "y": box["y"] + box["height"] / 2 + down}
    shot = page.screenshot(clip=at | {"width": 1, "height": 1})
    red, green = plt.imread(io.BytesIO(shot))[0, 0, :2]
    return bool(red > green + 0.1)


def test_map_is_drawn_at_the_carrier_position(
    chromium: Any, cut_log: Path, area: Path, tmp_path: Path
) -> None:
    (tmp_path / "settings.toml").write_text(f'[page]\nmap = "{area}"\n', encoding="utf-8")
    command = [BIN / "companion", "replay", cut_log, "--center", "5:1", "--no-record", "--serve"]
    command += ["--config", "settings.toml", "--listen", "127.0.0.1:0"]
    pipes: Any = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
    with started(command, cwd=tmp_path, **pipes) as process:
        lines = iter(lambda: line_of(process, process.stderr), "")
        said = (re.search(r"serves (http://\S+) and", line) for line in lines)
        url = next(found for found in said if found)[1]
        page = chromium.new_page(viewport={"width": 1280, "height": 900})
        asked, complaints = list[str](), list[str]()
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda line: line.type == "error" and complaints.append(line.text))
        page.goto(url)
        page.locator("#ground canvas").wait_for()
        page.locator("#uavs tbody tr").first.wait_for()
        page.evaluate("document.getElementById('plan').style.visibility = 'hidden'")
        while not (reddish(page, 0, 0) and not reddish(page, 150, 60)):
            pass  # the map is drawn tile by tile; a hanging test is terminated
        credit = page.locator("#ground").get_attribute("data-credit")
        page.close()
        process.terminate()
        process.communicate(timeout=HANG_S)
    assert credit == "made up"
    assert any("/v1/map/tiles" in address for address in asked)
    assert {each for each in asked if not each.startswith((url, "data:", "blob:"))} == set()
    assert complaints == []
