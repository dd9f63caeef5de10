"""Verdicts on links as messages to ground stations: STATUSTEXT at changes, and gains as numbers.

Pure: the caller passes in the verdicts and the time, and sends the messages that are due. Ground
stations show and speak a STATUSTEXT, and plot a NAMED_VALUE_FLOAT. The messages are those of the
common dialect (https://mavlink.io/en/messages/common.html#STATUSTEXT).
"""

from collections.abc import Mapping
from typing import Final

from companion.mavlink.wire.encode import Outgoing, named_value_float, statustext
from companion.values import Level, Source, Verdict

TEXT_NS: Final = 1_000_000_000  # least time between two texts
VALUES_NS: Final = 1_000_000_000  # time between two rounds of values
VALUES_MOST: Final = 16  # UAVs whose gain is sent in a round, the worst first
NAMED: Final = 3  # UAVs named in one text
SEVERITY: Final = {Level.NONE: 3, Level.WEAK: 4, Level.GOOD: 6}
"""MAV_SEVERITY: error, warning, info."""


class VerdictReports:
    """Reports of one service. Times are node times and do not decrease."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._reported: dict[str, Level] = {}
        self._text_ns: int | None = None
        self._values_ns: int | None = None

    def due(self, now_ns: int, verdicts: Mapping[str, Verdict]) -> list[Outgoing]:
        """Return the messages to send now.

        A text reports each change of a level once; UAVs with the same new level and cause share it.
        """
        out = list[Outgoing]()
        if self._text_ns is None or now_ns - self._text_ns >= TEXT_NS:
            text = self._text(verdicts)
            if text is not None:
                self._text_ns = now_ns
                out.append(text)
        if self._values_ns is None or now_ns - self._values_ns >= VALUES_NS:
            self._values_ns = now_ns
            out += self._values(now_ns, verdicts)
        return out

    def _text(self, verdicts: Mapping[str, Verdict]) -> Outgoing | None:
        for uav in [uav for uav in self._reported if uav not in verdicts]:
            del self._reported[uav]
        changed = [
            one
            for uav, one in verdicts.items()
            if self._reported.get(uav, Level.GOOD) is not one.level
        ]
        if not changed:
            return None
        first = min(changed, key=lambda one: one.level.rank)
        cause = None if first.blame is None else first.blame.cause
        alike = [
            one
            for one in changed
            if one.level is first.level
            and (None if one.blame is None else one.blame.cause) is cause
        ]
        self._reported |= {one.uav: one.level for one in alike}
        names = ",".join(one.uav for one in alike[:NAMED])
        names += f"+{len(alike) - NAMED}" if len(alike) > NAMED else ""
        text = f"Link {names} {first.level}" + ("" if cause is None else f": {cause}")
        return statustext(self._source, SEVERITY[first.level], text)

    def _values(self, now_ns: int, verdicts: Mapping[str, Verdict]) -> list[Outgoing]:
        """Return the number of good links, and by how much each gain exceeds its need, dB."""
        boot_ms = now_ns // 1_000_000 % 2**32
        good = sum(one.level is Level.GOOD for one in verdicts.values())
        spare_db = {
            uav: spare for uav, one in verdicts.items() if (spare := one.spare_gain_db) is not None
        }
        worst = sorted(spare_db, key=spare_db.__getitem__)[:VALUES_MOST]
        values = [("linksgood", float(good)), *((f"dB{uav}", spare_db[uav]) for uav in worst)]
        return [named_value_float(self._source, boot_ms, name, value) for name, value in values]
