"""JSON of described values."""

from companion.mavlink.links.status import LinkStatus
from companion.values import UtcNs
from companion.views.as_json import as_json


def test_containers_are_copied() -> None:
    """A thread encodes the JSON while the event loop counts on: a new key ended the request."""
    status = LinkStatus(url="udpin:127.0.0.1:14550", lost={"garbage": 1})
    shown = as_json(status, UtcNs)
    status.lost["bad-crc"] = 1
    assert shown["lost"] == {"garbage": 1}
