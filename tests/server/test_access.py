"""Addresses on which the server may listen, and the token that they require."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from companion.server.access import ListenError, bind
from companion.server.app import create_app


@pytest.mark.parametrize("token", [None, ""])
def test_public_address_requires_a_token_or_insecure_flag(token: str | None) -> None:
    """An empty token does not count; a valid one or the insecure flag does."""
    with pytest.raises(ListenError, match=r"0\.0\.0\.0:0: other machines can reach this address"):
        bind("0.0.0.0:0", token=token, insecure=False)
    with pytest.raises(ListenError, match=r"so short .*openssl rand"):
        bind("0.0.0.0:0", token="s" * 15, insecure=False)
    bind("0.0.0.0:0", token="s" * 16, insecure=False).close()
    bind("127.0.0.1:0", token="s", insecure=False).close()
    bind("0.0.0.0:0", token=token, insecure=True).close()


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_token_outside_ascii_is_accepted_in_both_encodings(make_node: Any, encoding: str) -> None:
    token = "pässwörter-für-alle"
    client = TestClient(create_app(make_node(flown=False), token), "http://127.0.0.1")
    right, wrong = (f"Bearer {one}".encode(encoding) for one in (token, token[:-1] + "é"))
    assert client.get("/v1/uavs", headers={"authorization": right}).status_code == 200
    assert client.get("/v1/uavs", headers={"authorization": wrong}).status_code == 401


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.0.0.7"])
def test_loopback_address_requires_no_token(host: str) -> None:
    bind(f"{host}:0", token=None, insecure=False).close()
