"""Allow and deny lists of UAVs."""

import pytest

from companion.mavlink.trust.admission import admission


@pytest.mark.parametrize(
    ("allow", "deny", "uav", "admitted"),
    [
        ((), (), "3:1", True),
        (("3:1",), (), "3:1", True),
        (("3:1",), (), "31:1", False),
        (("3:1",), (), "3:11", False),
        (("3:*",), (), "3:190", True),
        (("3:*",), (), "icao:4CA7B3", False),
        ((), ("icao:*",), "icao:4CA7B3", False),
        ((), ("icao:*",), "3:1", True),
        (("icao:4C*",), (), "icao:4CA7B3", True),
        (("icao:4C*",), (), "icao:3CA7B3", False),
        (("*:1",), ("3:1",), "3:1", False),
        (("*:1",), ("3:1",), "4:1", True),
    ],
)
def test_allow_and_deny_lists(
    allow: tuple[str, ...], deny: tuple[str, ...], uav: str, admitted: bool
) -> None:
    admits = admission(allow, deny)
    assert admits(uav) is admits(uav) is admitted
