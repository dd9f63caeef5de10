"""Detection of duplicate reports, which arrive over several links or twice over one.

A report is identified by its content: sender, message and payload. The sequence number is not part
of it, since every link has its own. GLOBAL_POSITION_INT carries a boot time, so equal content is
the same report. ADSB_VEHICLE carries none: ``adsb`` detects repeats there.
"""

from collections import OrderedDict, deque
from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.trust.path_lateness import PathLateness
from companion.values import Frame

WINDOW_NS: Final = 30_000_000_000
"""How long a report is remembered: longer than the largest lag observed between links."""
LINKS_MAX: Final = 4096  # most links counted; a log may name one for each of its frames
LATENCIES_KEPT: Final = 256  # newest latencies kept per link


@dataclass(slots=True)
class LinkShare:
    """Contribution of one link to the reports.

    latencies_s  latencies of the newest reports over this link, repeats included
    """

    first: int = 0  # reports that arrived over this link first
    repeats: int = 0  # reports that had arrived before
    latencies_s: deque[float] = field(default_factory=lambda: deque(maxlen=LATENCIES_KEPT))


@dataclass(slots=True, kw_only=True)
class _First:
    """First arrival of a report; its latency is None until known.

    ``doubt_s`` is how much larger it may be.
    """

    t_ns: int
    link: str
    sysid: int
    latency_s: float | None = None
    doubt_s: float = 0.0


class Dedupe:
    """Contents of the reports of the last ``WINDOW_NS``, with counts by link."""

    def __init__(self) -> None:
        self.shares: dict[str, LinkShare] = {}
        self._seen: OrderedDict[bytes, _First] = OrderedDict()  # in order of arrival
        self._newest: _First | None = None  # of these
        self._lateness = PathLateness()  # by link and system

    def is_repeat(self, frame: Frame) -> bool:
        """Count a frame; return True if the same content arrived before it, within the window."""
        seen, t_ns = self._seen, frame.t_ns
        while seen and next(iter(seen.values())).t_ns < t_ns - WINDOW_NS:
            seen.popitem(last=False)
        share = self._share(frame.link)
        key = content(frame.raw)
        first = seen.get(key)
        if first is None:
            seen[key] = self._newest = _First(t_ns=t_ns, link=frame.link, sysid=frame.source.sysid)
            share.first += 1
            return False
        share.repeats += 1
        if first.latency_s is not None:
            latency_s = first.latency_s + (t_ns - first.t_ns) * 1e-9
            share.latencies_s.append(latency_s)
            self._lateness.note((frame.link, first.sysid), t_ns, latency_s, first.doubt_s)
        return True

    def set_latency(self, latency_s: float, age_s: float) -> None:
        """Set the likely and the largest latency, in seconds, of the last new report."""
        first = self._newest
        assert first is not None
        first.latency_s, first.doubt_s = latency_s, age_s - latency_s
        self._share(first.link).latencies_s.append(latency_s)
        self._lateness.note((first.link, first.sysid), first.t_ns, latency_s, first.doubt_s)

    def late_s(self, frame: Frame) -> float:
        """Return how late a frame of another message may be, by the reports of its system.

        It may be as late as any report of the last seconds over the same link: its peers are not
        told apart. It may be later by the time for which the next report is overdue. 0 if there
        was no report in the last ``path_lateness.KEPT_NS``.
        """
        path = frame.link, frame.source.sysid
        late_s = self._lateness.largest_s(path, frame.t_ns)
        return 0.0 if late_s is None else late_s + self._lateness.overdue_s(path, frame.t_ns)

    def _share(self, link: str) -> LinkShare:
        share = self.shares.get(link)
        if share is None:
            share = LinkShare()
            if len(self.shares) < LINKS_MAX:
                self.shares[link] = share
        return share


def content(raw: bytes) -> bytes:
    """Return sender, message id and payload of a frame, without trailing zeros of the payload.

    MAVLink 2 truncates those; MAVLink 1 has one byte for the message id. Both versions give the
    same result.
    """
    if raw[0] == 0xFD:  # the fields are contiguous
        return raw[5 : 10 + raw[1]].rstrip(b"\0")
    return (raw[3:6] + b"\0\0" + raw[6 : 6 + raw[1]]).rstrip(b"\0")
