"""Counts of rejections, by sender and reason."""

from collections import Counter, OrderedDict
from dataclasses import dataclass, field
from typing import Final

from companion.mavlink.wire.positions import OWN
from companion.pipeline.records import UavRecords, UnusedRun
from companion.values import Notice, Reason, Rejection, Severity, UavKind, is_uav_id, kind_of
from companion.values.newest import Newest

REJECTED_AFTER_NS: Final = 1_000_000_000
"""Time without an accepted report of a sender after which a notice is published."""
ARRIVING_NS: Final = 5_000_000_000
"""Time since the newest rejected report after which a sender is silent, not rejected."""
NOTICE_INTERVAL_NS: Final = 10_000_000_000  # least time between two such notices about one sender
FULL_INTERVAL_NS: Final = 600_000_000_000
"""Least time between two notices that the limit on tracks is reached."""
REPORT_REASONS: Final = frozenset(
    {
        Reason.UNREACHABLE,
        Reason.ALTITUDE_JUMP,
        Reason.FROZEN,
        Reason.ZERO_POSITION,
        Reason.UNPLACED_STAMP,
        Reason.NO_FIX,
        Reason.OUT_OF_ORDER,
        Reason.SHARED_ID,
        Reason.NEWCOMER,
    }
)
"""Reasons to reject a sender's report about itself."""
SIGNATURE_REASONS: Final = frozenset({Reason.UNSIGNED, Reason.BAD_SIGNATURE, Reason.REPLAYED})
FRAME_REASONS: Final = SIGNATURE_REASONS | {Reason.STRANGER, Reason.MALFORMED}
"""Reasons to reject frames of any message; rejected positions are rejected reports."""
UNPROVEN: Final = SIGNATURE_REASONS | {Reason.STRANGER, Reason.NEWCOMER}
"""Reasons to reject frames that may be of anybody: ids can be forged in any number."""
OTHERWISE_ANNOUNCED: Final = frozenset({Reason.NEWCOMER, Reason.SHARED_ID, Reason.STRANGER})
"""Reasons to reject reports that have a notice of their own."""
UNSIGNED_REPORTS: Final = 5  # reports without a valid signature after which an id is named
UNSIGNED_INTERVAL_NS: Final = 60_000_000_000  # least time between two such notices
RECENT: Final = 8  # recent rejections kept per sender
SENDERS_MAX: Final = 4096
"""Most senders remembered, so that forged addresses cannot exhaust the memory.

Beyond it the least recently rejected one is forgotten.
"""


@dataclass(slots=True)
class SenderRejections:
    """Rejections of one sender (a UAV, component or link): counts by reason, and the newest."""

    counts: Counter[Reason] = field(default_factory=Counter)
    recent: Newest[Rejection] = field(default_factory=lambda: Newest(RECENT))


_NO_REJECTIONS: Final = SenderRejections()


class Refusals:
    """Counts of rejections by sender. ``total`` includes senders that were forgotten."""

    def __init__(self, records: UavRecords) -> None:
        self.total: Counter[Reason] = Counter()
        self._records = records
        self._senders: OrderedDict[str, SenderRejections] = OrderedDict()
        self._full_ns = -FULL_INTERVAL_NS  # when a notice told that the limit on tracks is reached
        self._unsigned_ns = -UNSIGNED_INTERVAL_NS  # when a notice named an id without a valid frame

    def add(self, refused: Rejection) -> Notice | None:
        """Count one rejection.

        Returns a notice if no report of the sender has been accepted for a second, or if the limit
        on tracks is reached.
        """
        self._count(refused)
        uav = refused.source
        if refused.reason is Reason.TOO_MANY and refused.detail:
            return self._full(refused)
        if refused.reason is Reason.SHARED_ID and kind_of(uav) is UavKind.ADSB:
            return self._shared_address(refused)
        if not _is_report(refused):
            return None
        if refused.reason in UNPROVEN and not self._records.is_kept(uav):
            return self._never_valid(refused)
        record = self._records[uav]
        if record.unused is None:
            record.unused = UnusedRun(
                since_ns=refused.t_ns, newest_ns=refused.t_ns, reason=refused.reason
            )
        run = record.unused
        run.reports += 1
        run.reason, run.newest_ns = refused.reason, refused.t_ns
        lasted_ns = refused.t_ns - run.since_ns
        if run.is_reported or run.reports < 2 or lasted_ns < REJECTED_AFTER_NS:
            return None
        if refused.reason in OTHERWISE_ANNOUNCED:
            return None
        run.is_reported = True
        notified_ns = record.unused_notice_ns
        if notified_ns is not None and refused.t_ns - notified_ns < NOTICE_INTERVAL_NS:
            return None
        record.unused_notice_ns = refused.t_ns
        why = f"{refused.reason}, {refused.detail}" if refused.detail else str(refused.reason)
        text = f"no report of {uav} was used in the last {lasted_ns * 1e-9:.1f} s: {why}"
        return Notice(t_ns=refused.t_ns, severity=Severity.WARNING, subject=uav, text=text)

    def _never_valid(self, refused: Rejection) -> Notice | None:
        """Return a notice that all signatures of a sender are invalid, about any one a minute."""
        uav, is_due = refused.source, refused.t_ns - self._unsigned_ns >= UNSIGNED_INTERVAL_NS
        if refused.reason not in SIGNATURE_REASONS or not is_due:
            return None
        if self.of(uav).counts[refused.reason] < UNSIGNED_REPORTS:
            return None
        self._unsigned_ns = refused.t_ns
        text = f"reports of {uav} are rejected: {refused.reason}; check its signing key and clock"
        return Notice(t_ns=refused.t_ns, severity=Severity.WARNING, subject=uav, text=text)

    def _full(self, refused: Rejection) -> Notice | None:
        if refused.t_ns - self._full_ns < FULL_INTERVAL_NS:
            return None
        self._full_ns = refused.t_ns
        text = f"{refused.detail}: {refused.source} and other new UAVs are not tracked"
        return Notice(t_ns=refused.t_ns, severity=Severity.WARNING, subject="tracks", text=text)

    def _shared_address(self, refused: Rejection) -> Notice | None:
        """Return a notice of two aircraft with one address; vehicles have one of their clocks."""
        uav = refused.source
        if not self._records.is_kept(uav):
            return None
        record = self._records[uav]
        before_ns, record.unused_notice_ns = record.unused_notice_ns, refused.t_ns
        if before_ns is not None and refused.t_ns - before_ns < NOTICE_INTERVAL_NS:
            return None
        text = f"two aircraft report under the id {uav}; the reports of both are rejected"
        return Notice(t_ns=refused.t_ns, severity=Severity.WARNING, subject=uav, text=text)

    def used(self, uav: str) -> None:
        """Note that a sender's report was accepted."""
        record = self._records.get(uav)
        if record is not None:
            record.unused = None

    def current_rejection(self, uav: str, now_ns: int) -> Reason | None:
        """Return why a sender's newest reports are rejected.

        None if they are accepted, or if none has arrived for ``ARRIVING_NS``; also for reasons in
        ``UNPROVEN`` while accepted ones may still come between.
        """
        record = self._records.get(uav)
        run = None if record is None else record.unused
        if run is None or run.reports < 2 or now_ns - run.newest_ns > ARRIVING_NS:
            return None
        is_between = run.newest_ns - run.since_ns < REJECTED_AFTER_NS
        return None if run.reason in UNPROVEN and is_between else run.reason

    def _count(self, refused: Rejection) -> None:
        self.total[refused.reason] += refused.count
        sender = self._senders.get(refused.source)
        if sender is None:
            sender = self._senders.setdefault(refused.source, SenderRejections())
            if len(self._senders) > SENDERS_MAX:
                self._senders.popitem(last=False)
        else:
            self._senders.move_to_end(refused.source)
        sender.counts[refused.reason] += refused.count
        sender.recent.append(refused)

    def of(self, sender: str) -> SenderRejections:
        """Return the rejections of one sender, to be read only; empty for an unknown one."""
        return self._senders.get(sender) or _NO_REJECTIONS


def _is_report(refused: Rejection) -> bool:
    """Return whether a vehicle's report about itself was rejected."""
    uav, reason = refused.source, refused.reason
    is_position = reason in FRAME_REASONS and refused.msgid in OWN
    return (
        (is_position or reason in REPORT_REASONS) and is_uav_id(uav) and kind_of(uav).reports_itself
    )
