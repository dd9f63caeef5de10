"""When the documents of a polled server were written, by the node's time.

A document that differs from the one before was written after that one was served, so after it was
requested, and before its own arrival. It states its time by the clock of its server, and so limits
that clock's offset. All documents must agree; together they limit the offset more closely than
each alone, because the phase between writing and polling varies.

The first document limits nothing: its receiver may have stopped long ago.
"""

from typing import Final, NamedTuple

ROUNDING_NS: Final = 50_000_000  # of the stated time; some servers state tenths of seconds
SERVED_NS: Final = 100_000_000
"""Time from the stated time of a document until it is served in place of the one before."""
SPAN_MAX_NS: Final = 10_000_000_000  # widest limits of a document that is used
DRIFT: Final = 1e-3  # largest drift of the server's clock; NTP slews by at most 5e-4


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

    def requested(self, t_ns: int) -> None:
        """Take note that a document is requested."""
        self._requested_ns = t_ns

    def is_new(self, stated_ns: int) -> bool:
        """Return whether a document is another one than the last."""
        return self._served_ns is None or stated_ns != self._stated_ns

    def arrived(self, t_ns: int, stated_ns: int) -> Written | None:
        """Return when the document that just arrived was written; None if unknown.

        It is unknown of the first one, of one after a long pause, and of one that disagrees with
        those before: then the server's clock was set, or an old document is served.
        """
        before_ns, self._served_ns = self._served_ns, self._requested_ns
        is_later, is_new = stated_ns > self._stated_ns, self.is_new(stated_ns)
        self._stated_ns = stated_ns
        if before_ns is None or not is_new:
            return None
        if not is_later:
            self._offset = None
            return None
        low_ns = before_ns - SERVED_NS - ROUNDING_NS - stated_ns
        high_ns = t_ns + ROUNDING_NS - stated_ns
        if self._offset is not None:
            drifted_ns = round(DRIFT * (t_ns - self._as_of_ns))
            low_ns = max(low_ns, self._offset[0] - drifted_ns)
            high_ns = min(high_ns, self._offset[1] + drifted_ns)
        self._offset, self._as_of_ns = None, t_ns
        if low_ns > high_ns:
            return None
        self._offset = (low_ns, high_ns)
        if high_ns - low_ns > SPAN_MAX_NS:
            return None
        latest_ns = min(high_ns + stated_ns + ROUNDING_NS, t_ns)
        return Written(low_ns + stated_ns - ROUNDING_NS, latest_ns)
