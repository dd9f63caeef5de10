"""Fair shares of an overloaded machine's time: a sender that takes more is limited.

The shares are max-min fair (https://en.wikipedia.org/wiki/Max-min_fairness): a sender that takes
less than the share keeps all of its frames. A sender that takes more floods. It is limited to
messages that matter, and to as many as take the share, within ``LEAST_PER_S`` and ``MOST_PER_S``. A
vehicle whose log is being downloaded floods too: its positions are still used.

A limit ends when the frames that it drops would fit again. For some seconds after an overload, no
other sender may begin to flood: known ones may send ``MOST_PER_S``, new ones ``LEAST_PER_S``. Ids
that flood in turn, each for a tenth of a second, could not be limited in time otherwise.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

from companion.values import Source
from companion.values.budget import Budget

LEAST_PER_S: Final = 10.0  # least limit of a sender, frames a second
MOST_PER_S: Final = 200.0
"""Largest limit; that of vehicles that the settings name, such as the carrier, in any case."""
LIMITED_NS: Final = 10_000_000_000  # least time of a limit, over which dropped frames are counted


class Account(NamedTuple):
    """What frames are charged to: a sender by its first peer or, if ``is_later``, by later ones."""

    source: Source
    is_later: bool = False


@dataclass(slots=True)
class Work:
    """Time that frames of an account took, and their number."""

    seconds: float = 0.0
    frames: int = 0


class _Limit:
    """Limit of one account: the frames that it may use, and how many were dropped since a time.

    ``of_flood``: for messages that matter, and with nothing saved.
    """

    __slots__ = ("dropped", "frames", "of_flood", "since_ns")

    def __init__(self, now_ns: int, per_s: float, *, of_flood: bool) -> None:
        self.frames = Budget(per_s=per_s, most=per_s / 2)
        if of_flood:
            self.frames.spend(per_s / 2, now_ns * 1e-9)
        self.of_flood = of_flood
        self.since_ns = now_ns
        self.dropped = 0


class FairShares:
    """Limits of all accounts that took more than their fair share."""

    def __init__(self) -> None:
        self._limits = dict[Account, _Limit]()
        self._frame_s = 0.0  # mean time of a frame

    def __len__(self) -> int:
        return len(self._limits)

    def is_limited(self, account: Account) -> bool:
        """Return whether an account is limited."""
        return account in self._limits

    def admits(self, account: Account, now_ns: int, *, matters: bool) -> bool:
        """Return whether a frame of a limited account may be used; count it if not."""
        limit = self._limits[account]
        is_usable = matters or not limit.of_flood
        is_admitted = is_usable and limit.frames.spend(1, now_ns * 1e-9)
        limit.dropped += not is_admitted
        return is_admitted

    def is_used_up(self, account: Account, now_ns: int) -> bool:
        """Return whether the next frame of a limited account would be dropped."""
        return not self._limits[account].frames.has(1, now_ns * 1e-9)

    def watch(self, account: Account, now_ns: int, *, is_new: bool) -> None:
        """Limit an account that is not limited yet, so that it does not begin to flood."""
        if account not in self._limits:
            per_s = LEAST_PER_S if is_new else MOST_PER_S
            self._limits[account] = _Limit(now_ns, per_s, of_flood=is_new)

    def forget(self, account: Account) -> None:
        """Forget the limit of an account, if it has one."""
        self._limits.pop(account, None)

    def note(self, work: Iterable[Work]) -> None:
        """Note the work of a window, for the mean time of a frame."""
        frames = seconds = 0.0
        for one in work:
            frames += one.frames
            seconds += one.seconds
        if frames:
            self._frame_s = seconds / frames

    def limit(
        self,
        now_ns: int,
        work: dict[Account, Work],
        *,
        passed_s: float,
        most_s: float,
        named: frozenset[Account],
    ) -> dict[Account, float]:
        """Limit the accounts that took more than their fair share of ``most_s``.

        ``work`` is that of a window of ``passed_s``. Returns the time that each account is expected
        to take in the next one.
        """
        level_s = fair_share(most_s, (one.seconds for one in work.values()))
        expected_s = dict[Account, float]()
        for account, done in work.items():
            frame_s = done.seconds / done.frames
            per_s = max(LEAST_PER_S, min(level_s / frame_s / passed_s, MOST_PER_S))
            if account in named:
                per_s = MOST_PER_S
            frames = per_s * passed_s
            is_flood = done.seconds > level_s and done.frames > frames
            if is_flood:
                self._limits[account] = _Limit(now_ns, per_s, of_flood=True)
            expected_s[account] = frames * frame_s if is_flood else done.seconds
        return expected_s

    def release(self, now_ns: int, free: float) -> bool:
        """Release accounts whose dropped frames would take less than a share ``free`` of the time.

        Returns whether there are any.
        """
        released = []
        for account, limit in self._limits.items():
            lasted_ns = now_ns - limit.since_ns
            if lasted_ns < LIMITED_NS:
                continue
            share = limit.dropped * self._frame_s / (lasted_ns * 1e-9)
            if share < free:
                free -= share
                released.append(account)
            limit.since_ns, limit.dropped = now_ns, 0
        for account in released:
            del self._limits[account]
        return bool(released)


def fair_share(most: float, wanted: Iterable[float]) -> float:
    """Return the max-min fair share: limited to it, what is wanted is ``most`` together.

    Infinite if all of it fits.
    """
    ordered = sorted(wanted)
    for number, amount in enumerate(ordered):
        level = most / (len(ordered) - number)
        if amount > level:
            return level
        most -= amount
    return float("inf")
