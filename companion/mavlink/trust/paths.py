"""Paths of a sender over its peers, and whether two of them can be of one vehicle.

Take two reports of one peer, dt apart, and a report of another peer whose stamp lies between them.
If both are of one vehicle, its distance from the straight line between the two is at most

    a dt^2 / 8    in position, and    a dt / 2    in velocity,

where a is the largest acceleration, plus an allowance for differences between the reports of one
vehicle: ``SLACK_M``, the noise of any report, and the distance flown in ``STALE_S``.
"""

import math
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from typing import Final

from companion.mavlink.wire.positions import OwnPosition
from companion.values import Vector

SLACK_M: Final = 3.0
STALE_S: Final = 0.1
SLACK_MPS: Final = 1.0
ACCELERATION_MPS2: Final = 20.0
STRETCH_MS: Final = 2000
"""Longest time between two reports of a peer that a third report is compared with."""
AHEAD_MS: Final = 250  # longest time by which a report is compared with an older one
RESTARTED_MS: Final = 10_000  # a stamp that is further off is from another boot, or clock
REPORTS_KEPT: Final = 32  # newest reports kept of a peer
OLDER_KEPT: Final = 64  # older ones, ``OLDER_MS`` apart: another link may be half a minute late
OLDER_MS: Final = 500

TURN_1E7: Final = 3_600_000_000  # a whole turn, in 1e-7 degrees
_METRES: Final = 111_195.0 * 1e-7  # metres in 1e-7 degrees of latitude


class Path:
    """Newest reports of a sender over one peer, in the order of their stamps."""

    __slots__ = ("_older", "_reports")

    def __init__(self) -> None:
        self._reports: deque[OwnPosition] = deque()
        self._older: deque[OwnPosition] = deque(maxlen=OLDER_KEPT)

    @property
    def newest(self) -> OwnPosition | None:
        """The report with the latest stamp; None without reports."""
        return self._reports[-1] if self._reports else None

    def newest_first(self) -> Iterator[OwnPosition]:
        """Return the reports that are kept, the newest first."""
        return chain(reversed(self._reports), reversed(self._older))

    def add(self, said: OwnPosition) -> bool:
        """Add a report, and return whether it continues the path; a restart begins another."""
        before = self.newest
        if before is not None and said.boot_ms <= before.boot_ms:
            if before.boot_ms - said.boot_ms > RESTARTED_MS:
                self._reports.clear()
                self._older.clear()
            return False
        self._reports.append(said)
        if len(self._reports) > REPORTS_KEPT:
            last = self._reports.popleft()
            if not self._older or last.boot_ms - self._older[-1].boot_ms >= OLDER_MS:
                self._older.append(last)
        return True

    def excess_m(
        self, other: "Path", before: OwnPosition | None, said: OwnPosition
    ) -> float | None:
        """Return how far a new report is off another peer's path, beyond what flight explains.

        The report is compared with the stretches of the other path, and the other's reports with
        the stretch that it ends, which begins at ``before``. None: not comparable. Above
        ``SLACK_M`` the two contradict each other.
        """
        pairs = [(said, *stretch) for stretch in around(other.newest_first(), said.boot_ms)]
        if before is not None:
            pairs += [(one, before, said) for one in within(other.newest_first(), before, said)]
        excesses = [one for one in (_excess_m(*pair) for pair in pairs) if one is not None]
        return max(excesses, default=None)

    def excess_ahead_m(self, said: OwnPosition) -> float | None:
        """Return the same for a report that is ahead of this path by at most ``AHEAD_MS``.

        With constant velocity the distance is at most a dt^2 / 2. Infinite if the velocities differ
        by more than ``SLACK_MPS`` and a dt.
        """
        last = self.newest
        if last is None or last.velocity_ned_mps is None:
            return None
        ahead_s = (said.boot_ms - last.boot_ms) * 1e-3
        if not 0 < ahead_s <= AHEAD_MS * 1e-3:
            return None
        velocity, most_mps = said.velocity_ned_mps, SLACK_MPS + ACCELERATION_MPS2 * ahead_s
        if velocity is not None and math.dist(velocity, last.velocity_ned_mps) > most_mps:
            return math.inf
        north, east, down = (ahead_s * speed for speed in last.velocity_ned_mps)
        scale_n, scale_e, _ = scales = _scales(said)
        lat, lon, alt = _place(last, said)
        there = (lat + north / scale_n, lon + east / scale_e, alt - down)
        off_m = math.hypot(
            *(
                scale * (a - b)
                for scale, a, b in zip(scales, _place(said, said), there, strict=True)
            )
        )
        stale_m = STALE_S * math.hypot(*last.velocity_ned_mps)
        return off_m - stale_m - ACCELERATION_MPS2 * ahead_s**2 / 2


def around(
    newest_first: Iterable[OwnPosition], boot_ms: int
) -> Iterator[tuple[OwnPosition, OwnPosition]]:
    """Yield the stretches of a path that contain a stamp (one, or two that meet), newest first."""
    for last, first in pairwise(newest_first):
        if boot_ms > last.boot_ms:
            return
        if first.boot_ms <= boot_ms:
            yield first, last


def within(
    newest_first: Iterable[OwnPosition], first: OwnPosition, last: OwnPosition
) -> Iterator[OwnPosition]:
    """Yield the reports of a path with stamps between those of two others, the newest first."""
    for one in newest_first:
        if one.boot_ms < first.boot_ms:
            return
        if one.boot_ms <= last.boot_ms:
            yield one


def _excess_m(said: OwnPosition, first: OwnPosition, last: OwnPosition) -> float | None:
    """Return how far a report between the stamps of two others is off, beyond what flight explains.

    Infinite if the velocity shows another sender; None if the stamps are too far apart to tell.
    """
    stretch_ms = last.boot_ms - first.boot_ms
    if stretch_ms > STRETCH_MS:
        return None
    share, dt_s = (said.boot_ms - first.boot_ms) / stretch_ms, stretch_ms * 1e-3
    velocities = [v for v in (one.velocity_ned_mps for one in (said, first, last)) if v is not None]
    fastest_mps = max((math.hypot(*velocity) for velocity in velocities), default=0.0)
    between = _between(_place(first, said), _place(last, said), share)
    places = zip(_scales(said), _place(said, said), between, strict=True)
    off_m = math.hypot(*(scale * (a - b) for scale, a, b in places))
    if len(velocities) == 3:
        velocity, before, after = velocities
        off_mps = math.dist(velocity, _between(before, after, share))
        if off_mps > SLACK_MPS + ACCELERATION_MPS2 * dt_s / 2:
            return math.inf
    return off_m - STALE_S * fastest_mps - ACCELERATION_MPS2 * dt_s**2 / 8


def _scales(said: OwnPosition) -> Vector:
    """Return metres per unit of latitude, longitude and height at a report."""
    return _METRES, _METRES * math.cos(math.radians(said.lat_1e7 * 1e-7)), 1.0


def _place(said: OwnPosition, near: OwnPosition) -> Vector:
    """Return latitude, longitude (next to another one, also beyond 180 degrees) and height."""
    east_1e7 = math.remainder(said.lon_1e7 - near.lon_1e7, TURN_1E7)
    return said.lat_1e7, near.lon_1e7 + east_1e7, said.alt_m


def _between(one: Vector, two: Vector, share: float) -> list[float]:
    return [a + share * (b - a) for a, b in zip(one, two, strict=True)]
