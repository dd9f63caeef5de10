"""Addresses on which the server may listen, and the token that they require."""

import pytest

from companion.server.access import ListenError, bind


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


def test_token_that_http_does_not_carry_is_an_error() -> None:
    with pytest.raises(ListenError, match="COMPANION_TOKEN contains characters"):
        bind("127.0.0.1:0", token="pässwörter-für-alle", insecure=False)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "127.0.0.7"])
def test_loopback_address_requires_no_token(host: str) -> None:
    bind(f"{host}:0", token=None, insecure=False).close()
