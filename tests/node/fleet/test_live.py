"""What a node of a fleet refuses to begin with, in one line."""

import socket

import pytest

from companion.node.fleet.config import bus_config
from companion.node.fleet.live import FleetNode
from companion.pipeline.fold import Pipeline
from companion.settings.fleet import FleetSettings
from companion.settings.model import Settings
from companion.settings.section import ConfigError
from companion.values import UserError

pytest.importorskip("zenoh")


def node(**settings: object) -> FleetNode:
    pipeline = Pipeline(Settings().override(center={"source": "47,8,400"}))
    given = FleetSettings.model_validate({"node": "north", **settings})
    return FleetNode(given, pipeline, lambda event: None, lambda notice: None, lambda: 0)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"ca": "ca.pem"}, "a certificate and its key are needed"),
        ({"certificate": "me.pem"}, "fleet.ca is needed"),
        ({"mode": "client"}, "a client needs a router"),
    ],
)
def test_settings_that_make_no_sense_together(settings: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        node(**settings)


@pytest.mark.parametrize("endpoint", ["foo", "tcp/192.0.2.1:7447"])
def test_an_endpoint_that_cannot_be_had(endpoint: str) -> None:
    with pytest.raises(UserError, match="Zenoh"):
        node(listen=[endpoint]).open()


def test_a_port_that_is_taken_is_said_before_anything_runs() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(UserError, match="Zenoh"):
            node(listen=[f"tcp/127.0.0.1:{taken.getsockname()[1]}"]).open()


@pytest.mark.parametrize("name", ["", "a/b", "a*", "-a", "x" * 33, "a b"])
def test_a_name_that_is_none(name: str) -> None:
    with pytest.raises(ValueError, match="node"):
        FleetSettings(node=name)


def test_a_node_listens_on_this_machine_alone_unless_told_otherwise() -> None:
    config = bus_config(FleetSettings(node="north"))
    assert config.listen == ("tcp/127.0.0.1:0",)
    assert not config.scouting
