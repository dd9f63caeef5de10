"""BlueOS: the description that it looks for, and the labels of the extension's image.

`tests/test_confinement.py` runs the command of the image.
"""

import json
import re
import shlex
from typing import Any

from starlette.testclient import TestClient
from support import ROOT

import companion
from companion.server.app import create_app
from companion.settings.model import Settings

FOLDER = ROOT / "examples" / "blueos"


def test_service_describes_itself_without_a_token(make_node: Any) -> None:
    app = create_app(make_node(), "a" * 20)
    client = TestClient(app, "http://localhost")
    found = client.get("/register_service")
    assert found.status_code == 200
    assert found.json()["version"] == companion.__version__
    for name in ("webpage", "api"):
        assert client.get(found.json()[name]).status_code == 200


def test_description_has_the_fields_that_blueos_requires(make_node: Any) -> None:
    """Those of BlueOS's class ServiceMetadata. The page may not be framed, so BlueOS must know."""
    client = TestClient(create_app(make_node(), None), "http://127.0.0.1:8080")
    found = client.get("/register_service").json()
    texts = {"name", "description", "icon", "company", "version", "webpage", "api"}
    assert {name for name, value in found.items() if isinstance(value, str)} == texts
    assert found.keys() - texts == {"avoid_iframes"}
    page = client.get("/")
    assert "<title>" in page.text  # BlueOS looks for it
    framed = "frame-ancestors 'none'" not in page.headers["content-security-policy"]
    assert found["avoid_iframes"] is not framed


def test_page_opens_under_the_names_of_blueos(make_node: Any) -> None:
    text = (FOLDER / "companion.toml").read_text()
    chosen = Settings.from_toml(text, "companion.toml").server.model_dump()
    app = create_app(make_node(server=chosen), None)
    for name in ("blueos.local", "blueos-wifi.local", "192.168.2.2"):
        assert TestClient(app, f"http://{name}:8080").get("/").status_code == 200, name
    assert TestClient(app, "http://elsewhere.local:8080").get("/").status_code == 421


def test_commented_settings_are_valid() -> None:
    text = (FOLDER / "companion.toml").read_text()
    uncommented = re.sub(r"^# (?=\[presence|enabled|system_id)", "", text, flags=re.MULTILINE)
    presence = Settings.from_toml(uncommented, "companion.toml").presence
    assert presence.enabled and presence.system_id == 200


def test_labels_of_the_extension_are_those_that_blueos_reads() -> None:
    """Names and types of BlueOS's repository of extensions; permissions in Docker's API 1.41."""
    text = (FOLDER / "Dockerfile").read_text()
    labels = dict(re.findall(r"^LABEL (\w+)=(.+)$", text, re.MULTILINE))
    assert labels.keys() == {
        "version", "permissions", "authors", "company", "type", "tags", "requirements",
    }  # fmt: skip
    values = {name: " ".join(shlex.split(value)) for name, value in labels.items()}
    assert f"ARG VERSION={companion.__version__}\n" in text
    permissions = json.loads(values["permissions"])
    assert permissions.keys() == {"HostConfig"}
    host = permissions["HostConfig"]
    assert host.pop("NetworkMode") == "host"
    assert host.pop("CapDrop") == ["ALL"] and host.pop("ReadonlyRootfs") is True
    assert host.pop("SecurityOpt") == ["no-new-privileges"]
    assert host.pop("Tmpfs") == {"/tmp": "size=64m"}
    assert host.pop("Binds") == ["/usr/blueos/extensions/companion:/recordings"]
    assert host.pop("Memory") == 512 * 2**20 and host.pop("PidsLimit") == 128
    assert not host
    (author,), company = json.loads(values["authors"]), json.loads(values["company"])
    assert author.keys() == {"name", "email"} and company.keys() == {"name", "about", "email"}
    assert values["type"] in {
        "device-integration",
        "example",
        "theme",
        "other",
        "tool",
        "education",
    }
    tags = json.loads(values["tags"])
    assert len(tags) <= 10 and all(re.fullmatch("[a-z0-9-]+", tag) for tag in tags)
