"""Whether a vehicle has a GNSS fix, and for how long its position has been dead reckoned."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from companion.tracking.noise import FORGOTTEN_NS, SETTLED_NS

MOMENT_NS: Final = 1_200_000_000
"""Time after a status with a fix for which the vehicle counts as having one.

The position drifts by at most 0.36 m in it.
"""
SECOND_SILENT_NS: Final = 5_000_000_000
"""Longest time between two statuses of the second receiver, both with a fix, that is no loss.

The bound grows in it all the same; afterwards the loss is announced.
"""
TRUSTED_NS: Final = 10_000_000_000
"""Time for which a vehicle must have stated a fix, so that its loss lasts until the next fix.

What was forged in a gap of a vehicle's radio would last for ever otherwise.
"""
NOTICE_NS: Final = 60_000_000_000  # least time between two notices of a kind about one vehicle
SILENT_NS: Final = 10_000_000_000
"""Time without GPS_RAW_INT, of a vehicle that stated fixes regularly, that is announced."""
REGULAR_NS: Final = 5_000_000_000
"""Longest time between two regular statuses, of a receiver or an estimator."""
NEVER_NS: Final = 2**63 - 1


class FixNotice(Enum):
    """What must be announced about the fix of a vehicle."""

    LOST = "GNSS fix lost; its position bound grows until the fix returns"
    FIRST_LOST = (
        "first GNSS receiver lost its fix; the bound assumes that the autopilot uses the second one"
    )
    DEAD_RECKONING = "navigates without GNSS; its position bound grows until it uses GNSS again"
    SILENT = "no GPS_RAW_INT for 10 s; until it returns, a lost GNSS fix would not be noticed"


@dataclass(slots=True, kw_only=True)
class GnssFix:
    """Fix of a vehicle's receivers, by GPS_RAW_INT of the first and GPS2_RAW of the second.

    A vehicle that never had a fix navigates by other means: it loses none.

    is_certain   whether the position is that of a receiver with a fix
    since_ns     arrival of the first status with a fix; None: there was none
    fixed_ns     arrival of the newest one, of either receiver
    second_ns    arrival of the second receiver's newest status, if that has a fix; else None
    has_first    whether the first receiver's newest status has a fix
    before_s     time of dead reckoning before the fix returned, if it may still matter; of earlier
                 losses too, if the fix between them was too short to settle the position
    regained_ns  arrival of the status with which the fix returned
    heard_ns     arrival of the newest status of the first receiver
    relative_ns  arrival of the estimator's newest status, if that states a position without GNSS
    silent_ns    from when on a silent first receiver must be announced
    notified_ns  when each kind of notice was given last
    """

    is_certain: bool = True
    since_ns: int | None = None
    fixed_ns: int = 0
    second_ns: int | None = None
    has_first: bool = True
    before_s: float = 0.0
    regained_ns: int = 0
    heard_ns: int = 0
    relative_ns: int | None = None
    silent_ns: int = NEVER_NS
    notified_ns: dict[FixNotice, int] = field(default_factory=dict)

    def note_first(self, *, has_fix: bool, t_ns: int) -> FixNotice | None:
        """Note a status of the first receiver; return what must be announced."""
        if t_ns - self.heard_ns <= REGULAR_NS:
            self.silent_ns = t_ns + SILENT_NS
        self.heard_ns = t_ns
        if self.relative_ns is not None and has_fix:
            has_fix = not self._is_relative(t_ns)
        if has_fix and self.is_certain and self.since_ns is not None:  # nearly always
            self.fixed_ns = t_ns
            return None
        if has_fix:
            self._note_fix(t_ns)
            self.has_first, self.is_certain = True, not self.before_s
            return None
        if self.since_ns is None:
            return None
        self.has_first = self.is_certain = False
        return self._loss(t_ns)

    def note_second(self, *, has_fix: bool, t_ns: int) -> FixNotice | None:
        """Note a status of the second receiver; return what must be announced."""
        if not has_fix or self._is_relative(t_ns):
            self.second_ns = None
            return self._loss(t_ns)
        if self.second_ns is None or t_ns - self.second_ns > SECOND_SILENT_NS:
            self._note_fix(t_ns)
        self.fixed_ns = self.second_ns = t_ns
        return None

    def note_estimator(self, *, is_absolute: bool, t_ns: int) -> FixNotice | None:
        """Note whether the estimator uses GNSS in flight; return what must be announced.

        Without, a fix of the receivers counts for nothing. A statement lasts ``TRUSTED_NS``.
        """
        self.relative_ns = None if is_absolute else t_ns
        if is_absolute or self.since_ns is None:
            return None
        self.has_first = self.is_certain = False
        self.second_ns = None
        return self._loss(t_ns)

    def note_silence(self, t_ns: int, before_ns: int | None) -> FixNotice | None:
        """Note a position after ``silent_ns``; return what must be announced.

        ``before_ns`` is the arrival of the position before it: after a gap of the whole link,
        statuses may still follow.
        """
        if before_ns is None or t_ns - before_ns > REGULAR_NS:
            self.silent_ns = t_ns + SILENT_NS
            return None
        self.silent_ns = NEVER_NS
        is_known = self.since_ns is not None and self.is_certain
        return self._notice(FixNotice.SILENT, t_ns) if is_known else None

    def restarted(self, *, is_in_flight: bool) -> None:
        """Note that the vehicle was restarted, which forgets all fixes on the ground.

        In flight a redundant autopilot took over. Its statuses show whether it has a fix.
        """
        self.relative_ns, self.silent_ns = None, NEVER_NS
        if is_in_flight:
            return
        self.since_ns = self.second_ns = None
        self.has_first, self.is_certain, self.before_s = True, True, 0.0

    @property
    def is_trusted(self) -> bool:
        """Whether it stated a fix for so long that it was no stranger in a gap of its radio."""
        return self.since_ns is not None and self.fixed_ns - self.since_ns >= TRUSTED_NS

    def dead_reckoning_s(self, t_ns: int) -> float:
        """Return for how long the position has been dead reckoned; 0 with a fix.

        After the fix returned, the position may still be as wrong: for as long as the fix was lost,
        at most for ``SETTLED_NS``.
        """
        if self.is_certain:
            return 0.0
        if not self._is_lost(t_ns):
            return self._unsettled_s(t_ns)
        if not self.is_trusted and t_ns - self.heard_ns > FORGOTTEN_NS:
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

    def _is_lost(self, t_ns: int, silent_ns: int = MOMENT_NS) -> bool:
        """Return whether neither receiver has a fix, if the second one was silent for so long."""
        if self.has_first:
            return False
        return self.second_ns is None or t_ns - self.second_ns > silent_ns

    def _is_relative(self, t_ns: int) -> bool:
        """Return whether the estimator states a position without GNSS."""
        return self.relative_ns is not None and t_ns - self.relative_ns <= TRUSTED_NS

    def _unsettled_s(self, t_ns: int) -> float:
        """Return the dead reckoning before the fix that has been there until now; 0 if settled."""
        lasts_ns = min(SETTLED_NS, round(self.before_s * 1e9))
        return 0.0 if t_ns - self.regained_ns >= lasts_ns else self.before_s

    def _loss(self, t_ns: int) -> FixNotice | None:
        if self.has_first:
            return None
        if self._is_relative(t_ns):
            return self._notice(FixNotice.DEAD_RECKONING, t_ns)
        is_lost = self._is_lost(t_ns, SECOND_SILENT_NS)
        return self._notice(FixNotice.LOST if is_lost else FixNotice.FIRST_LOST, t_ns)

    def _notice(self, what: FixNotice, t_ns: int) -> FixNotice | None:
        if t_ns - self.notified_ns.get(what, -NOTICE_NS) < NOTICE_NS:
            return None
        self.notified_ns[what] = t_ns
        return what
