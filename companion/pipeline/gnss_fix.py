"""Whether a vehicle has a GNSS fix, and for how long its position has been dead reckoned."""

from dataclasses import dataclass
from typing import Final

from companion.tracking.noise import FORGOTTEN_NS, SETTLED_NS

SECOND_RECEIVER_NS: Final = 1_000_000_000
"""Time after a status of a second receiver with a fix in which the first one needs none.

The position drifts by 0.25 m in it.
"""
TRUSTED_NS: Final = 10_000_000_000
"""Time for which a vehicle must have stated a fix, so that its loss lasts until the next fix.

What was forged in a gap of a vehicle's radio would last for ever otherwise.
"""
MOMENT_NS: Final = 1_200_000_000
"""Time between two statuses with a fix, in which one without a fix is of no account.

The position drifts by 0.36 m in it, and the receiver corrects that.
"""
NOTICE_NS: Final = 60_000_000_000  # least time between two notices of one vehicle


@dataclass(slots=True, kw_only=True)
class GnssFix:
    """Fix of a vehicle's receivers, by GPS_RAW_INT of the first and GPS2_RAW of the second.

    A vehicle that never had a fix navigates by other means: it loses none.

    since_ns     arrival of the first status with a fix; None: there was none
    fixed_ns     arrival of the newest one, of either receiver
    second_ns    arrival of the second receiver's newest status, if that has a fix; else None
    has_first    whether the first receiver's newest status has a fix
    before_s     time of dead reckoning before the fix returned, in several losses without a fix
                 between them that lasted as long
    regained_ns  arrival of the status with which it returned
    heard_ns     arrival of the newest status of the first receiver
    notified_ns  when its loss was announced
    """

    since_ns: int | None = None
    fixed_ns: int = 0
    second_ns: int | None = None
    has_first: bool = True
    before_s: float = 0.0
    regained_ns: int = 0
    heard_ns: int = 0
    notified_ns: int = -NOTICE_NS

    @property
    def is_certain(self) -> bool:
        """Whether the position is that of a receiver with a fix; cheap, and asked most often."""
        return self.has_first and not self.before_s

    def note_first(self, *, has_fix: bool, t_ns: int) -> bool:
        """Note a status of the first receiver; return whether a loss must be announced."""
        self.heard_ns = t_ns
        if has_fix:
            self._note_fix(t_ns)
            self.has_first = True
            return False
        if self.since_ns is None:
            return False
        self.has_first = False
        return self._is_news(t_ns)

    def note_second(self, *, has_fix: bool, t_ns: int) -> bool:
        """Note a status of the second receiver; return whether a loss must be announced."""
        if has_fix:
            self._note_fix(t_ns)
            self.second_ns = t_ns
            return False
        self.second_ns = None
        return self._is_news(t_ns)

    def restarted(self) -> None:
        """Forget all fixes: the vehicle was restarted."""
        self.since_ns = self.second_ns = None
        self.has_first, self.before_s = True, 0.0

    def dead_reckoning_s(self, t_ns: int) -> float:
        """Return for how long the position has been dead reckoned; 0 with a fix.

        After the fix returned, the position may still be as wrong: for as long as the fix was lost,
        at most for ``SETTLED_NS``.
        """
        if self.is_certain:
            return 0.0
        if not self._is_lost(t_ns):
            return self._unsettled_s(t_ns)
        assert self.since_ns is not None
        is_trusted = self.fixed_ns - self.since_ns >= TRUSTED_NS
        if not is_trusted and t_ns - self.heard_ns > FORGOTTEN_NS:
            return 0.0
        return self._unsettled_s(self.fixed_ns) + max(0, t_ns - self.fixed_ns) * 1e-9

    def _note_fix(self, t_ns: int) -> None:
        if self.since_ns is None:
            self.since_ns = t_ns
        elif self._is_lost(t_ns) and t_ns - self.fixed_ns > MOMENT_NS:
            self.before_s = self.dead_reckoning_s(t_ns)
            self.regained_ns = t_ns
        elif self.before_s and not self._unsettled_s(t_ns):
            self.before_s = 0.0
        self.fixed_ns = t_ns

    def _is_lost(self, t_ns: int) -> bool:
        if self.has_first:
            return False
        return self.second_ns is None or t_ns - self.second_ns > SECOND_RECEIVER_NS

    def _unsettled_s(self, t_ns: int) -> float:
        """Return the dead reckoning before the fix that has been there until now; 0 if settled."""
        lasts_ns = min(SETTLED_NS, round(self.before_s * 1e9))
        return 0.0 if t_ns - self.regained_ns >= lasts_ns else self.before_s

    def _is_news(self, t_ns: int) -> bool:
        if not self._is_lost(t_ns) or t_ns - self.notified_ns < NOTICE_NS:
            return False
        self.notified_ns = t_ns
        return True
