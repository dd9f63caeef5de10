"""BlueOS: the description that it looks for, and the labels of the extension's image."""

import json
import re
import shlex
from typing import Any

from starlette.testclient import TestClient
from support import ROOT

import companion
from companion.server.app import create_app

DOCKERFILE = ROOT / "examples" / "blueos" / "Dockerfile"


def test_service_describes_itself_without_a_token(make_node: Any) -> None:
    app = create_app(make_node(), "a" * 20)
    client = TestClient(app, "http://localhost")
    found = client.get("/register_service")
    assert found.status_code == 200
    assert found.json()["version"] == companion.__version__
    for name in ("webpage", "api"):
        assert client.get(found.json()[name]).status_code == 200


def test_labels_of_the_extension_are_those_that_blueos_reads() -> None:
    text = DOCKERFILE.read_text()
    labels = dict(re.findall(r"^LABEL (\w+)=(.+)$", text, re.MULTILINE))
    assert labels.keys() == {
        "version", "permissions", "authors", "company", "type", "tags", "requirements",
    }  # fmt: skip
    values = {name: " ".join(shlex.split(value)) for name, value in labels.items()}
    host = json.loads(values["permissions"])["HostConfig"]
    assert host["NetworkMode"] == "host"
    assert host["CapDrop"] == ["ALL"] and host["ReadonlyRootfs"]
    assert "Privileged" not in host
    assert host["Binds"] == ["/usr/blueos/extensions/companion:/recordings"]
    assert json.loads(values["authors"]) and json.loads(values["tags"])
    assert json.loads(values["company"])["name"]
