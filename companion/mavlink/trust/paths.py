"""Paths of a sender over its peers, and whether two of them can be of one vehicle.

Take two reports of one peer, dt apart, and a report of another peer whose stamp lies between them.
If both are of one vehicle, its distance from the straight line between the two is at most

    a dt^2 / 8    in position, and    a dt / 2    in velocity,

where a is the largest acceleration, plus an allowance for differences between the reports of one
vehicle: ``SLACK_M``, the noise of any report, and the distance flown in ``STALE_S``.
"""

import math
from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from typing import Final

from companion.mavlink.wire.positions import OwnPosition
from companion.values import Vector

SLACK_M: Final = 3.0
STALE_S: Final = 0.1
SLACK_MPS: Final = 1.0
ACCELERATION_MPS2: Final = 20.0
STRETCH_MS: Final = 2000
"""Longest time between two reports of a peer that a third report is compared with."""
RESTARTED_MS: Final = 10_000  # a stamp that steps back further is from another boot
REPORTS_KEPT: Final = 32  # newest reports kept of a peer

_METRES: Final = 111_195.0 * 1e-7  # metres in 1e-7 degrees of latitude


class Path:
    """Newest reports of a sender over one peer, in the order of their stamps."""

    __slots__ = ("reports",)

    def __init__(self) -> None:
        self.reports: deque[OwnPosition] = deque(maxlen=REPORTS_KEPT)

    @property
    def newest(self) -> OwnPosition | None:
        """The report with the latest stamp; None without reports."""
        return self.reports[-1] if self.reports else None

    def add(self, said: OwnPosition) -> bool:
        """Add a report, and return whether it continues the path; a restart begins another."""
        before = self.newest
        if before is not None and said.boot_ms <= before.boot_ms:
            if before.boot_ms - said.boot_ms > RESTARTED_MS:
                self.reports.clear()
            return False
        self.reports.append(said)
        return True

    def agrees_with(
        self, other: "Path", before: OwnPosition | None, said: OwnPosition
    ) -> bool | None:
        """Return whether a new report agrees with another peer's path; None: not comparable.

        The report is compared with the stretches of the other path, and the other's reports with
        the stretch that it ends, which begins at ``before``.
        """
        pairs = [(said, *stretch) for stretch in around(other.reports, said.boot_ms)]
        if before is not None:
            pairs += [(one, before, said) for one in within(other.reports, before, said)]
        agreed = [one for one in (_agrees(*pair) for pair in pairs) if one is not None]
        return all(agreed) if agreed else None


def around(reports: deque[OwnPosition], boot_ms: int) -> Iterator[tuple[OwnPosition, OwnPosition]]:
    """Yield the stretches of a path that contain a stamp (one, or two that meet), newest first."""
    for last, first in pairwise(reversed(reports)):
        if boot_ms > last.boot_ms:
            return
        if first.boot_ms <= boot_ms:
            yield first, last


def within(
    reports: deque[OwnPosition], first: OwnPosition, last: OwnPosition
) -> Iterator[OwnPosition]:
    """Yield the reports of a path with stamps between those of two others, the newest first."""
    for one in reversed(reports):
        if one.boot_ms < first.boot_ms:
            return
        if one.boot_ms <= last.boot_ms:
            yield one


def _agrees(said: OwnPosition, first: OwnPosition, last: OwnPosition) -> bool | None:
    """Return whether a report between the stamps of two others can be from their sender.

    None if they are too far apart to tell.
    """
    stretch_ms = last.boot_ms - first.boot_ms
    if stretch_ms > STRETCH_MS:
        return None
    share, dt_s = (said.boot_ms - first.boot_ms) / stretch_ms, stretch_ms * 1e-3
    velocities = [v for v in (one.velocity_ned_mps for one in (said, first, last)) if v is not None]
    fastest_mps = max((math.hypot(*velocity) for velocity in velocities), default=0.0)
    limit_m = SLACK_M + STALE_S * fastest_mps + ACCELERATION_MPS2 * dt_s**2 / 8
    scales = (_METRES, _METRES * math.cos(math.radians(said.lat_1e7 * 1e-7)), 1.0)
    between = _between(_place(first), _place(last), share)
    places = zip(scales, _place(said), between, strict=True)
    if math.hypot(*(scale * (a - b) for scale, a, b in places)) > limit_m:
        return False
    if len(velocities) < 3:
        return True
    velocity, before, after = velocities
    off_mps = math.dist(velocity, _between(before, after, share))
    return off_mps <= SLACK_MPS + ACCELERATION_MPS2 * dt_s / 2


def _place(said: OwnPosition) -> Vector:
    return said.lat_1e7, said.lon_1e7, said.alt_m


def _between(one: Vector, two: Vector, share: float) -> list[float]:
    return [a + share * (b - a) for a, b in zip(one, two, strict=True)]
