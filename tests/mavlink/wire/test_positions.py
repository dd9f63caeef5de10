"""The table of position messages, held against the dialect and against those who use it."""

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.voice.component import ACCEPTED_IDS
from companion.mavlink.wire.decode import DECODED, POSE
from companion.mavlink.wire.positions import OWN, POSITIONS
from companion.pipeline.fleet.reception import SHARED


@pytest.mark.parametrize("msgid", POSITIONS)
def test_names_are_those_of_the_dialect(msgid: int) -> None:
    assert POSITIONS[msgid].name == dialect.mavlink_map[msgid].msgname


def test_a_position_message_is_used_wherever_positions_are() -> None:
    assert POSITIONS.keys() <= DECODED
    assert OWN
    for users in (POSE, SHARED, ACCEPTED_IDS):
        assert users >= OWN
