"""When the documents of a polled server were written, by the node's time.

A document that differs from the one before was written after that one was served, so after it was
requested, and before its own arrival. It states its time by the clock of its server, and so limits
that clock's offset. All documents must agree; together they limit the offset more closely than
each alone, because the phase between writing and polling varies. The first one limits it on one
side only: its receiver may have stopped long ago.

A document that seems to be written later than the limits allow is late, as from a slow proxy, or
the clock was set back: both may be true within ``SPAN_MAX_NS``. The limits are kept. A document
that seems to be written too early belongs to a clock that was set forward: a few of these in a row
begin new limits.
"""

from collections import deque
from typing import Final, NamedTuple

from companion.mavlink.wire.foreign import LATE_MAX_NS

ROUNDING_NS: Final = 50_000_000  # of the stated time; some servers state tenths of seconds
SERVED_NS: Final = 100_000_000
"""Time from the stated time of a document until it is served in place of the one before."""
SPAN_MAX_NS: Final = LATE_MAX_NS  # widest limits of a document that is used
DRIFT: Final = 1e-3  # largest drift of the server's clock; NTP slews by at most 5e-4
RECENT: Final = 10  # newest documents that are counted
LATE_MAX: Final = 3  # number of these that are too late, from which on the server is late
EARLY_RUN: Final = 3  # documents in a row that begin new limits
_UNLIMITED_NS: Final = -(1 << 80)


class Written(NamedTuple):
    """Limits on the time at which a document was written, node time."""

    earliest_ns: int
    latest_ns: int


class DocumentTimes:
    """Times of the documents of one server, each given by ``requested``, then ``arrived``."""

    def __init__(self) -> None:
        self._requested_ns = 0  # when the newest document was requested
        self._served_ns: int | None = None  # request of the newest document that was received
        self._stated_ns = 0  # by that document
        self._offset: tuple[int, int] | None = None  # limits on node time less the server's
        self._as_of_ns = 0  # arrival of the document that limited it last
        self._late = deque[bool](maxlen=RECENT)  # of the newest documents, whether too late
        self._early = 0  # documents in a row that seem to be written too early

    @property
    def is_late(self) -> bool:
        """Whether too many documents were too late to be used."""
        return sum(self._late) >= LATE_MAX

    def requested(self, t_ns: int) -> None:
        """Note that a document is requested."""
        self._requested_ns = t_ns

    def is_new(self, stated_ns: int) -> bool:
        """Return whether a document is another one than the last."""
        return self._served_ns is None or stated_ns != self._stated_ns

    def arrived(self, t_ns: int, stated_ns: int) -> Written | None:
        """Return when the document that just arrived was written; None if that is unknown."""
        is_new = self.is_new(stated_ns)
        before_ns, self._served_ns = self._served_ns, self._requested_ns
        self._stated_ns = stated_ns
        if not is_new:
            return None
        low_ns, high_ns = _UNLIMITED_NS, t_ns + ROUNDING_NS - stated_ns
        if before_ns is not None:
            low_ns = before_ns - SERVED_NS - ROUNDING_NS - stated_ns
        limits = self._limits(t_ns)
        is_late = limits is not None and low_ns > limits[1]
        is_early = limits is not None and high_ns < limits[0]
        self._early = self._early + 1 if is_early else 0
        if limits is None or self._early >= EARLY_RUN:
            low_ns = _UNLIMITED_NS
            self._early = 0
        elif is_early:
            return None
        elif is_late:
            low_ns = limits[0]
        else:
            low_ns, high_ns = max(low_ns, limits[0]), min(high_ns, limits[1])
        if not is_late:
            self._offset, self._as_of_ns = (low_ns, high_ns), t_ns
        earliest_ns = low_ns + stated_ns - ROUNDING_NS
        latest_ns = min(high_ns + stated_ns + ROUNDING_NS, t_ns)
        is_usable = latest_ns - earliest_ns <= SPAN_MAX_NS
        self._late.append(is_late and not is_usable)
        return Written(earliest_ns, latest_ns) if is_usable else None

    def _limits(self, t_ns: int) -> tuple[int, int] | None:
        """Return the limits on the offset at a time; None before the first document."""
        if self._offset is None:
            return None
        drifted_ns = round(DRIFT * (t_ns - self._as_of_ns))
        return self._offset[0] - drifted_ns, self._offset[1] + drifted_ns
