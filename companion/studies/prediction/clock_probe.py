"""Which stamped messages the product's clocks hear, found by asking a pipeline.

The baselines' clock is the product's, and is to hear neither more nor less than it.
"""

import struct
from functools import cache
from typing import Final

from companion.mavlink.wire.decode import GLOBAL_POSITION_INT
from companion.mavlink.wire.encode import Outgoing, pack
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.studies.truth import stamps
from companion.values import Frame, Source

_SENDER: Final = Source(1, 1)
_SOON_NS: Final = 100_000_000
_LATE_NS: Final = 500_000_000


@cache
def hears(msgid: int) -> bool:
    """Whether a stamp of this message, faster than the one before, moves the product's clock."""
    if msgid == GLOBAL_POSITION_INT:
        return True
    pipeline = Pipeline(Settings())
    report = struct.pack("<Iiii", 1000, 474_000_000, 85_000_000, 500_000)
    from_ns = 1_700_000_000_000_000_000
    _say(pipeline, from_ns + _LATE_NS, GLOBAL_POSITION_INT, report)
    before = pipeline.clock_estimate(str(_SENDER))
    _say(pipeline, from_ns + _LATE_NS + _SOON_NS, msgid, stamps.payload(msgid, 1000 + 600))
    after = pipeline.clock_estimate(str(_SENDER))
    assert before is not None
    return after is not None and after.offset_ns != before.offset_ns


def _say(pipeline: Pipeline, t_ns: int, msgid: int, payload: bytes) -> None:
    raw = pack(Outgoing(_SENDER, msgid, payload), 0)
    pipeline.step(Frame(t_ns, "probe", _SENDER, msgid, raw))
