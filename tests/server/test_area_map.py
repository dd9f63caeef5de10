"""The map under the plan view: byte ranges of the user's file, never of a file named in a log."""

import os
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from companion.server import area_map
from companion.server.app import create_app
from companion.values import UserError


@pytest.fixture
def area(tmp_path: Path) -> Path:
    path = tmp_path / "area.pmtiles"
    path.write_bytes(b"PMTiles\x03" + bytes(range(200)))
    return path


def test_map_file_is_served_by_ranges(shared_node: Any, area: Path) -> None:
    whole = area.read_bytes()
    with TestClient(create_app(shared_node, area=area_map.find(str(area)))) as client:
        assert client.get("/v1/map").json() == {"name": "area.pmtiles"}
        asked = client.get("/v1/map/tiles", headers={"range": "bytes=5-17"})
        assert (asked.status_code, asked.content) == (206, whole[5:18])
        assert client.get("/v1/map/tiles").content == whole
        beyond = client.get("/v1/map/tiles", headers={"range": "bytes=9999-"})
        assert (beyond.status_code, beyond.headers["content-range"]) == (416, "bytes */208")


def test_map_that_becomes_a_pipe_is_not_opened(shared_node: Any, area: Path) -> None:
    """Opening a pipe for reading waits for a writer, on a thread that others need."""
    with TestClient(create_app(shared_node, area=area)) as client:
        tag = client.get("/v1/map/tiles").headers["etag"]
        area.write_bytes(b"PMTiles\x03" + bytes(300))
        assert client.get("/v1/map/tiles").headers["etag"] != tag
        area.unlink()
        os.mkfifo(area)
        assert client.get("/v1/map/tiles").status_code == 404


def test_no_map_is_served_when_none_is_configured(shared_node: Any) -> None:
    with TestClient(create_app(shared_node)) as client:
        assert client.get("/v1/map").json() == {"name": None}
        assert client.get("/v1/map/tiles").status_code == 404


def test_map_requires_the_token(shared_node: Any, area: Path) -> None:
    client = TestClient(create_app(shared_node, "s3cret", area))
    assert client.get("/v1/map/tiles").status_code == 401
    allowed = {"authorization": "Bearer s3cret"}
    assert client.get("/v1/map/tiles", headers=allowed).status_code == 200


def test_invalid_map_file_is_rejected_at_start(tmp_path: Path, area: Path) -> None:
    assert area_map.find(None) is None
    assert area_map.find(str(area)) == area
    (tmp_path / "old.pmtiles").write_bytes(b"PMTiles\x02" + bytes(200))
    for name, says in (("old.pmtiles", "not a PMTiles file"), ("gone", "No such file")):
        with pytest.raises(UserError, match=says):
            area_map.find(str(tmp_path / name))
    with pytest.raises(UserError, match="Is a directory"):
        area_map.find(str(tmp_path))


def test_pipe_in_place_of_a_map_is_not_opened(tmp_path: Path) -> None:
    """Opening it would wait for a writer, and the service would not start."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="not a file"):
        area_map.find(str(tmp_path / "pipe"))
