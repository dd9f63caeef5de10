"""Boot clock of a sender as one peer delivers it: how late its messages are, by their stamps."""

from typing import Final

from companion.mavlink.trust.paths import RESTARTED_MS
from companion.mavlink.wire.positions import OWN, read
from companion.mavlink.wire.stamps import STAMPED, boot_ms, stamp_step
from companion.values import Frame

DRIFT: Final = 100e-6  # largest drift of a boot clock, ten times that of a good crystal
AHEAD_MS: Final = 1000
"""Largest lead of a stamp over the fastest that a peer known earlier has delivered.

A clock follows a smaller lead at once, and would follow a larger one once several stamps agree.
"""
SAMPLE_NS: Final = 1_000_000_000  # time between two messages that are compared with the fastest


class PeerClock:
    """The fastest message of a peer, and the delay of others beyond it.

    Messages that are more than ``RESTARTED_MS`` late begin anew; those before are kept too, for the
    peer may have become late.

    ``due_ns`` is when the next message is to be observed: the delay need not be followed by each.
    """

    __slots__ = ("_fastest", "_former", "due_ns")

    def __init__(self) -> None:
        self.due_ns = 0
        self._fastest: Frame | None = None
        self._former: Frame | None = None  # the fastest one before it began anew

    def observe(self, frame: Frame) -> None:
        """Note a message with a stamp. One of another boot clock begins anew."""
        self.due_ns = frame.t_ns + SAMPLE_NS
        late_ms = self.late_ms(frame)
        if late_ms is None or late_ms <= 0.0:
            self._fastest = frame
        elif late_ms > RESTARTED_MS:
            self._former, self._fastest = self._fastest, frame

    def late_ms(self, frame: Frame) -> float | None:
        """Return the delay of a message beyond the fastest one; None without one.

        Negative for a stamp that this peer could not have delivered as early.
        """
        return None if self._fastest is None else _late_ms(self._fastest, frame)

    def had(self, frame: Frame) -> bool:
        """Return whether a stamp is of the clock that the peer had before it began anew.

        It is at most ``RESTARTED_MS`` later than the fastest message of that clock, and at most
        ``AHEAD_MS`` ahead of it.
        """
        if self._former is None:
            return False
        return -AHEAD_MS <= _late_ms(self._former, frame) <= RESTARTED_MS


def _late_ms(fastest: Frame, frame: Frame) -> float:
    elapsed_ms = (frame.t_ns - fastest.t_ns) * 1e-6
    return elapsed_ms * (1.0 - DRIFT) - stamp_step(stamp_ms(frame), stamp_ms(fastest))


def stamp_ms(frame: Frame) -> int:
    """Return the stamp of a message of ``STAMPED``, or of a sender's own position."""
    return boot_ms(frame) if frame.msgid in STAMPED else read(frame).boot_ms


def has_stamp(frame: Frame) -> bool:
    """Return whether a message has a stamp of its sender's boot clock."""
    return frame.msgid in STAMPED or frame.msgid in OWN
