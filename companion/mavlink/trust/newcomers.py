"""Admission: new senders so many a second; on a busy machine, first senders before new ones.

Anybody that reaches a link's port can invent senders. Each takes a clock, a track and beams, so the
number of new ones is limited. When frames take more than ``BUSY`` of the time and are lost, or read
late in two windows, those of strangers (``known_peers``) are dropped before they are decoded. Then
senders are limited to their fair share of the time (``fair_share``), so that a flood of some costs
no other its place. If that is not enough, those of the newest senders are dropped, until the rest
are in time: the first senders keep being served. Receivers rank behind vehicles, whichever came
first. What later peers bring of a sender counts as a sender of its own: a flood in a vehicle's name
costs its first peer nothing.

Where something else takes the time, such as requests, frames take less than ``BUSY`` of it. Once
they have been late for a second and are lost, or too old to be of use, half of their work is
dropped, since all become two seconds late otherwise; but none of the first eight senders, or of
those that were there through ten seconds in time. While the process stays busy, more are served
only after a time that doubles. Frames in time for ten seconds let more senders be served anyway.
"""

from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Callable
from enum import Enum, auto
from typing import Final

from companion.mavlink.trust.fair_share import LIMITED_NS, Account, FairShares, Work
from companion.mavlink.trust.known_peers import PeerRank
from companion.mavlink.wire import cot_link, rid_json, transponder
from companion.values import Source
from companion.values.budget import Budget

RECEIVERS: Final = frozenset((cot_link.SENDER, rid_json.SENDER, transponder.SENDER))
NEW_PER_S: Final = 50.0  # new senders a second
NEW_SAVED: Final = 500.0  # new senders at once, as when a fleet is switched on
RECEIVERS_AFTER: Final = 256
"""Senders admitted after a receiver that precede it, so that it costs no vehicle its place.

More do not, or a flood of invented senders would cost the receiver its place.
"""
SENDERS_MAX: Final = 4096
"""Most senders remembered; beyond it the one silent for longest is new again."""
BUSY: Final = 0.5  # share of the time above which frames of the newest senders are dropped
IDLE: Final = 0.35  # share below which more senders are served again
STRANGERS_WAIT_NS: Final = 10_000_000_000  # time for which strangers are not served after that
LATE_NS: Final = 50_000_000  # age of a datagram that was read late
USELESS_NS: Final = 500_000_000  # age of a datagram that is of no use to a beam
LATE_FOR_NS: Final = 1_000_000_000
"""Time of late windows in turn after which useless frames cost senders their place."""
FIRST: Final = 8  # oldest senders, which are not dropped where something else takes the time
FITS: Final = 1.1  # ratio of expected work to what fits, up to which no sender is dropped
FREE: Final = 0.5  # share of one processor below which nothing else takes the time
LEAST: Final = 0.2  # share of the time below which fewer senders would make no difference
HELD_NS: Final = 5_000_000_000, 20_000_000_000
"""Time for which no more senders are served after half of the work was dropped.

The first such time, and the longest: it doubles if work must be dropped again.
"""
BACKLOG_NS: Final = 2_500_000_000
"""Least time between two such drops: frames that wait in a socket are up to two seconds old."""
CALM_NS: Final = 10_000_000_000
"""Time without a late frame that settles the senders that were there when it began."""
KEPT_NS: Final = 5_000_000_000  # time between two looks at which senders are active
WINDOW_NS: Final = 250_000_000  # time over which the share is measured
LOSSY_WINDOW_NS: Final = 50_000_000  # the same once frames are lost: a socket is full in 0.1 s


class Admission(Enum):
    """Whether a sender's frame is used: not, this one, or all until ``generation`` changes."""

    DROPPED = auto()
    ONE = auto()
    ALL = auto()


class Newcomers:
    """Senders of all links, in the order of their admission. ``refused`` counts frames.

    What ``admits`` says of a sender holds while ``generation`` stays the same. That changes from
    time to time, so that ``admits`` learns which senders are active. ``worked_s`` is the time that
    frames took since the last call of ``adapt``, due from ``adapts_ns``; ``worked`` says whose.

    ``is_named`` says whether the settings name a vehicle: those are always admitted, so that a
    service that starts during a flood serves them. Their fair share is larger.
    """

    def __init__(self, is_named: Callable[[str], bool] = lambda _: False) -> None:
        self._is_named = is_named
        self.refused = 0
        self.generation = 0
        self.worked_s = 0.0
        self.adapts_ns = 0
        self._work = dict[Account, Work]()  # since then, of each that is served
        self._numbers: OrderedDict[Account, int] = OrderedDict()  # by the newest frame
        self._budget = Budget(per_s=NEW_PER_S, most=NEW_SAVED)
        self._count = 0
        self._served_below: int | None = None  # number from which senders are not served
        self._had_strangers = False  # whether strangers were served since the machine was late
        self._strangers_from_ns = -(1 << 62)  # time from which those of strangers are served
        self._began_ns = 0
        self._used_s = self._process_s = 0.0
        self._shares = FairShares()
        self._watched_until_ns = -(1 << 62)  # time until which no sender may begin to flood
        self._changed_ns = 0
        self._is_late = self._is_lossy = self._is_useless = False
        self._late_since_ns: int | None = None  # since when each window was late
        self._held_ns, self._held_until_ns = HELD_NS[0], -(1 << 62)
        self._dropped_ns = -(1 << 62)  # when half of the work was dropped
        self._calm_since = 0, 0  # time, and number of the next sender then
        self._settled_below = 0  # number of the first sender that is not settled

    def admits(
        self, source: Source, now_ns: int, rank: PeerRank = PeerRank.FIRST, *, matters: bool = True
    ) -> Admission:
        """Return whether a frame may be used; count it if not.

        ``rank`` is that of its peer; ``matters`` says whether its message may affect a track, a
        bound or a clock.
        """
        found = self._admission(source, now_ns, rank, matters)
        self.refused += found is Admission.DROPPED
        return found

    def _admission(self, source: Source, now_ns: int, rank: PeerRank, matters: bool) -> Admission:
        if rank is PeerRank.STRANGER:
            if now_ns < self._strangers_from_ns:
                return Admission.DROPPED
            self._had_strangers = True
        account = Account(source, rank is not PeerRank.FIRST)
        if not self._is_named(str(source)):
            is_new = account not in self._numbers
            if is_new and not self._budget.spend(1, now_ns * 1e-9):
                return Admission.DROPPED
            if not self._is_served(self._number(account)):
                return Admission.DROPPED
            if now_ns < self._watched_until_ns:
                self._shares.watch(account, now_ns, is_new=is_new)
        if self._shares.is_limited(account):
            is_used = self._shares.admits(account, now_ns, matters=matters)
            return Admission.ONE if is_used else Admission.DROPPED
        return Admission.ONE if rank is PeerRank.STRANGER else Admission.ALL

    def _number(self, account: Account) -> int:
        """Return the place of an account in the order of admission; a new one comes last."""
        number = self._numbers.get(account)
        if number is not None:
            self._numbers.move_to_end(account)
            return number
        number = self._count + RECEIVERS_AFTER * (account.source in RECEIVERS)
        self._numbers[account] = number
        self._count += 1
        if len(self._numbers) > SENDERS_MAX:
            silent, _ = self._numbers.popitem(last=False)
            self._shares.forget(silent)
        return number

    def _is_served(self, number: int) -> bool:
        return self._served_below is None or number < self._served_below

    def is_dropped(self, source: Source, now_ns: int) -> bool:
        """Return whether frames of a sender's first peer are dropped at present; counts nothing."""
        account = Account(source)
        if self._shares.is_limited(account) and self._shares.is_used_up(account, now_ns):
            return True
        number = self._numbers.get(account)
        return number is not None and not (self._is_served(number) or self._is_named(str(source)))

    def late(self, age_ns: int | None = None) -> None:
        """Note that frames were read late, at that age; None: they were lost."""
        self._is_late = True
        if age_ns is None:
            self._is_lossy = True
            self.adapts_ns = min(self.adapts_ns, self._began_ns + LOSSY_WINDOW_NS)
        self._is_useless |= age_ns is None or age_ns > USELESS_NS

    def worked(self, account: Account, spent_s: float) -> None:
        """Note the time that a frame took, if it was used; ``worked_s`` has the time of all."""
        work = self._work.get(account)
        if work is None:
            work = self._work[account] = Work()
        work.seconds += spent_s
        work.frames += 1

    def adapt(self, now_ns: int, used_s: float, process_s: float) -> None:
        """Adapt who is served to the share of the time that frames took.

        ``used_s`` and ``process_s`` are the processor times that the calling thread, and all
        threads, have used so far: a process that is stopped, or waits for a processor, is late
        without any fault of its senders.
        """
        passed_s = max(1, now_ns - self._began_ns) * 1e-9
        worked_s, work = self.worked_s, self._work
        share = min(worked_s, used_s - self._used_s) / passed_s
        is_free = (process_s - self._process_s) / passed_s < FREE
        self.worked_s, self._work = 0.0, {}
        self._shares.note(work.values())
        self._used_s, self._process_s = used_s, process_s
        began_ns = self._began_ns
        self._began_ns, self.adapts_ns = now_ns, now_ns + WINDOW_NS
        if now_ns - self._changed_ns > KEPT_NS:
            self.generation += 1
            self._changed_ns = now_ns
        # Once late may be a long update; a flood is late again.
        is_late = self._is_lossy or (self._is_late and self._late_since_ns is not None)
        if not self._is_late:
            self._late_since_ns = None
        elif self._late_since_ns is None:
            self._late_since_ns = began_ns
        was_calm = self._note_calm(now_ns)
        is_useless = (
            self._is_useless
            and self._late_since_ns is not None
            and now_ns - self._late_since_ns >= LATE_FOR_NS
            and share > LEAST
            and now_ns - self._dropped_ns >= BACKLOG_NS
        )
        self._is_late = self._is_lossy = self._is_useless = False
        if is_late and (share > BUSY or is_useless):
            if not self._drop_strangers(now_ns):
                self._save_time(now_ns, work, passed_s=passed_s, worked_s=worked_s, share=share)
        elif was_calm or (share < IDLE and (is_free or now_ns >= self._held_until_ns)):
            self.generation += self._shares.release(now_ns, BUSY - share)
            self._serve_more()

    def _save_time(
        self,
        now_ns: int,
        work: dict[Account, Work],
        *,
        passed_s: float,
        worked_s: float,
        share: float,
    ) -> None:
        """Limit senders to their fair share; if that is not enough, drop the newest."""
        is_busy = share > BUSY
        most_s = worked_s * BUSY / share if is_busy else worked_s / 2
        named = frozenset(
            one for one in work if not one.is_later and self._is_named(str(one.source))
        )
        expected_s = self._shares.limit(now_ns, work, passed_s=passed_s, most_s=most_s, named=named)
        self.generation += 1
        self._watched_until_ns = now_ns + LIMITED_NS
        if sum(expected_s.values()) > FITS * most_s:
            self._drop(expected_s, most_s, 0 if is_busy else max(FIRST, self._settled_below))
            if not is_busy:
                self._hold(now_ns)

    def _drop_strangers(self, now_ns: int) -> bool:
        """Serve no strangers for a time. Return whether that drops some that were served."""
        drops = now_ns >= self._strangers_from_ns and self._had_strangers
        self._strangers_from_ns = now_ns + STRANGERS_WAIT_NS
        self._had_strangers &= not drops
        return drops

    def _serve_more(self) -> None:
        """Serve some more senders, the oldest of those that are dropped."""
        if self._served_below is not None:
            numbers = sorted(self._numbers.values())
            served = bisect_left(numbers, self._served_below)
            self._serve(numbers, max(served + 8, served * 5 // 4))

    def _hold(self, now_ns: int) -> None:
        """Serve no more senders for a time; it doubles if the last such time was recent."""
        self._dropped_ns = now_ns
        least_ns, most_ns = HELD_NS
        is_again = now_ns - self._held_until_ns < most_ns
        self._held_ns = min(2 * self._held_ns, most_ns) if is_again else least_ns
        self._held_until_ns = now_ns + self._held_ns

    def _note_calm(self, now_ns: int) -> bool:
        """Note which senders are there while frames are in time.

        Return whether they have been for another ten seconds.
        """
        since_ns, count = self._calm_since
        if self._is_late:
            self._calm_since = now_ns, self._count
        elif now_ns - since_ns >= CALM_NS:
            self._settled_below = count
            self._calm_since = now_ns, self._count
            return True
        return False

    def _drop(self, worked_s: dict[Account, float], most_s: float, kept_below: int = 0) -> None:
        """Serve the oldest senders whose frames took at most ``most_s`` together.

        Always one, and those with numbers below ``kept_below``.
        """
        numbers = sorted((number, account) for account, number in self._numbers.items())
        if self._served_below is not None:
            del numbers[bisect_left(numbers, (self._served_below,)) :]
        total_s, most = sum(worked_s.values()), len(numbers)
        least = max(1, bisect_left(numbers, (kept_below,)))
        while most > least and total_s > most_s:
            most -= 1
            total_s -= worked_s.get(numbers[most][1], 0.0)
        self._serve(sorted(self._numbers.values()), most)

    def _serve(self, numbers: list[int], most: int) -> None:
        """Serve this many of the senders with these numbers, the oldest."""
        self.generation += 1
        self._served_below = None if most >= len(numbers) else numbers[most]
