"""Aircraft relayed by ADS-B receivers: one stream of reports for each aircraft over all relays.

ADSB_VEHICLE has no time stamp. ``tslc`` counts whole seconds since the aircraft's last message, so
a position was true at its arrival less ``tslc``, or up to a second earlier. Receivers repeat
messages, with or without changes, and not every message has every field:

- Fields are merged one by one, each with the time at which it was true; the newest counts.
- A message that repeats a reported position and contradicts no other field is a duplicate,
  from any relay and with any stated age. Its other fields are dated like that position.
- A message without a position cannot be recognised as a repeat, since a cruising aircraft keeps
  its altitude: its ``tslc`` is trusted.
- Pressure altitude differs from geometric altitude with the weather, by up to hundreds of metres.
  A track that mixes them jumps, so an aircraft keeps its datum while that is fresh. Otherwise the
  datum of the message itself comes first, then geometric, then pressure.

See docs/field-notes.md 1 for the behaviour of real relays.
"""

import math
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Final, TypeVar

from companion.mavlink.trust.reported_positions import Reported, ReportedPositions
from companion.mavlink.wire.transponder import ADSB_VEHICLE
from companion.values import AdsbVehicle, AltitudeDatum, Reason, Rejection, Report, Source

_NS: Final = 1_000_000_000
SLACK_NS: Final = _NS
"""Resolution of times in whole seconds: the order of two closer times is unknown."""
ALTITUDE_KEPT_NS: Final = 10 * _NS
"""Largest time between a position and the altitude that completes it."""
VELOCITY_KEPT_NS: Final = SLACK_NS
"""Largest time between a position and the velocity that completes it.

The error of an old velocity is unbounded: at a bank angle of 30 degrees it changes by 5.7 m/s every
second. Within ``SLACK_NS`` the two may be simultaneous. Transponders send both twice a second (RTCA
DO-260B), so older ones are seldom needed.
"""
REPEATED_NS: Final = 30 * _NS
"""How long the same position counts as a repeat; later, the aircraft may be hovering."""
HOVERING_NS: Final = 3 * _NS
"""The same if the aircraft states that it hovers: relays repeat a message for up to 2.6 s."""
HOVERING_MPS: Final = 1.0  # largest speed of a hovering aircraft: steps of a knot, and noise
FORGOTTEN_S: Final = 120
"""Seconds without a message after which an aircraft is forgotten; older messages are discarded."""
AIRCRAFT_MAX: Final = 2000
"""Most aircraft remembered; beyond it the one silent for longest is forgotten."""
RELAYS_KEPT: Final = 16  # relays remembered of each aircraft

_T = TypeVar("_T")
_Dated = tuple[int, _T]  # when it was true, and the value


@dataclass(slots=True, kw_only=True)
class _RelayedAircraft:
    news_ns: int = 0
    moved_ns: int = 0  # arrival of the newest message that states that it moves
    position_ns: int | None = None  # when the newest reported position was true
    datum: AltitudeDatum | None = None
    altitudes: dict[AltitudeDatum, _Dated[float]] = field(default_factory=dict)
    heading: _Dated[float] | None = None
    velocity_ne: _Dated[tuple[float, float]] | None = None
    velocity_down: _Dated[float] | None = None
    callsign: _Dated[str] | None = None
    reported: ReportedPositions = field(default_factory=ReportedPositions)
    relays: dict[Source, int] = field(default_factory=dict)  # last message, ns

    def hear(self, relay: Source, t_ns: int) -> None:
        """Record that a relay reported the aircraft at ``t_ns``."""
        self.relays.pop(relay, None)
        self.relays[relay] = t_ns
        while len(self.relays) > RELAYS_KEPT or _is_past(next(iter(self.relays.values())), t_ns):
            del self.relays[next(iter(self.relays))]

    def learn(self, message: AdsbVehicle, true_ns: int) -> None:
        """Store every field of a message that is present and newer than the stored one."""
        velocity_mps = message.velocity_ne_mps or (0.0, 0.0)
        if math.hypot(*velocity_mps, message.velocity_down_mps or 0.0) > HOVERING_MPS:
            self.moved_ns = message.t_ns
        if message.alt_datum is not None:
            altitude = _newest(self.altitudes.get(message.alt_datum), true_ns, message.alt_m)
            if altitude is not None:
                self.altitudes[message.alt_datum] = altitude
        self.heading = _newest(self.heading, true_ns, message.heading_deg)
        self.velocity_ne = _newest(self.velocity_ne, true_ns, message.velocity_ne_mps)
        self.velocity_down = _newest(self.velocity_down, true_ns, message.velocity_down_mps)
        self.callsign = _newest(self.callsign, true_ns, message.callsign)

    def repeated(self, message: AdsbVehicle) -> Reported | None:
        """Return the reported message that a message repeats; None if it has new content."""
        assert message.position_deg is not None
        before = self.reported.get(message.position_deg)
        if before is None or _differs(before, message):
            return None
        is_later = message.true_ns - before.true_ns >= SLACK_NS
        repeated_ns = HOVERING_NS if self._hovers(message) else REPEATED_NS
        return None if is_later and message.t_ns - before.t_ns > repeated_ns else before

    def _hovers(self, message: AdsbVehicle) -> bool:
        """Return whether the aircraft states that it hovers, and lately nothing else.

        A relay that lags still says so when others have reported that it flies on.
        """
        if message.t_ns - self.moved_ns <= HOVERING_NS:
            return False
        velocity_mps = _fitting(message.velocity_ne_mps, self.velocity_ne, message.true_ns)
        down_mps = _fitting(message.velocity_down_mps, self.velocity_down, message.true_ns) or 0.0
        return velocity_mps is not None and math.hypot(*velocity_mps, down_mps) <= HOVERING_MPS

    def altitude(self, message: AdsbVehicle) -> tuple[AltitudeDatum, float, int] | None:
        """Return datum, metres and age (ns) of the altitude that belongs to a new position."""
        true_ns = message.true_ns
        choice = (self.datum, message.alt_datum, AltitudeDatum.GEOMETRIC, AltitudeDatum.PRESSURE)
        for datum in choice:
            if datum is not None and datum is message.alt_datum and message.alt_m is not None:
                return datum, message.alt_m, 0
            known = self.altitudes.get(datum) if datum is not None else None
            if datum is not None and known is not None:
                age_ns = abs(true_ns - known[0])
                if age_ns <= ALTITUDE_KEPT_NS:
                    return datum, known[1], age_ns
        return None

    def report(self, message: AdsbVehicle, at_deg: tuple[float, float]) -> Report | None:
        """Return the report of a new position; None if no altitude is known for that position."""
        altitude = self.altitude(message)
        if altitude is None:
            return None
        true_ns = message.true_ns
        self.datum, alt_m, age_ns = altitude
        self.position_ns = max(true_ns, self.position_ns or true_ns)
        self.reported.put(at_deg, message)
        return Report(
            t_ns=message.t_ns,
            uav=message.uav,
            source=message.source,
            lat_deg=at_deg[0],
            lon_deg=at_deg[1],
            alt_m=alt_m,
            alt_datum=self.datum,
            relative_alt_m=None,
            velocity_ne_mps=_fitting(message.velocity_ne_mps, self.velocity_ne, true_ns),
            velocity_down_mps=_fitting(message.velocity_down_mps, self.velocity_down, true_ns),
            heading_deg=_fitting(message.heading_deg, self.heading, true_ns),
            boot_ms=None,
            tslc_s=float(message.tslc_s),
            alt_age_s=age_ns * 1e-9,
            accuracy=message.accuracy,
        )


class Aircraft:
    """State of all relayed aircraft. ``merge`` takes their messages in order of arrival.

    At most ``AIRCRAFT_MAX`` are remembered, and none longer than ``FORGOTTEN_S`` without news.
    Their names are those of ``AdsbVehicle.uav``.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[str, _RelayedAircraft] = (
            OrderedDict()
        )  # the longest without news first

    def merge(self, message: AdsbVehicle) -> Report | Rejection:
        """Merge a message: return a report if its position is new, else a rejection.

        The report is completed from earlier messages. Reasons:

            NO_POSITION   no position; its other fields are merged
            NO_ALTITUDE   no altitude is known for the position; its fields are merged
            DUPLICATE     the position was reported before
            OUT_OF_ORDER  certainly older than a reported one, or at least ``FORGOTTEN_S`` old
        """
        while self._known and _is_past(next(iter(self._known.values())).news_ns, message.t_ns):
            self._known.popitem(last=False)
        known = self._known.get(message.uav)
        if known is not None:
            known.hear(message.source, message.t_ns)
        if message.tslc_s >= FORGOTTEN_S:
            return _rejected(message, Reason.OUT_OF_ORDER, f"{message.tslc_s} s old")
        if known is None:
            known = self._begin(message)
        if message.position_deg is not None:
            before = known.repeated(message)
            if before is not None:
                known.learn(message, before.true_ns)
                return _rejected(message, Reason.DUPLICATE)
        true_ns = message.true_ns
        known.learn(message, true_ns)
        known.news_ns = message.t_ns
        self._known.move_to_end(message.uav)
        if message.position_deg is None:
            return _rejected(message, Reason.NO_POSITION)
        if known.position_ns is not None and true_ns <= known.position_ns - SLACK_NS:
            late_s = (known.position_ns - true_ns) * 1e-9
            return _rejected(
                message,
                Reason.OUT_OF_ORDER,
                f"{late_s:.1f} s older than the newest message of this aircraft",
            )
        report = known.report(message, message.position_deg)
        return report if report is not None else _rejected(message, Reason.NO_ALTITUDE)

    def relays(self, uav: str) -> tuple[Source, ...]:
        """Return the relays that reported an aircraft in the last ``FORGOTTEN_S``, newest first."""
        known = self._known.get(uav)
        return tuple(reversed(known.relays)) if known is not None else ()

    def datum(self, uav: str) -> AltitudeDatum | None:
        """Return the datum of the altitudes in an aircraft's reports.

        None before the first report.
        """
        known = self._known.get(uav)
        return known.datum if known is not None else None

    def callsign(self, uav: str) -> str | None:
        """Return the aircraft's own callsign; None if unknown."""
        known = self._known.get(uav)
        return known.callsign[1] if known is not None and known.callsign is not None else None

    def _begin(self, message: AdsbVehicle) -> _RelayedAircraft:
        known = self._known.setdefault(message.uav, _RelayedAircraft(news_ns=message.t_ns))
        known.hear(message.source, message.t_ns)
        if len(self._known) > AIRCRAFT_MAX:
            self._known.popitem(last=False)
        return known


def _is_past(then_ns: int, t_ns: int) -> bool:
    return t_ns - then_ns > FORGOTTEN_S * _NS


def _newest(before: _Dated[_T] | None, true_ns: int, value: _T | None) -> _Dated[_T] | None:
    """Return the newer of two values with their times: the received one or the stored one."""
    if value is None or (before is not None and true_ns < before[0]):
        return before
    return true_ns, value


def _fitting(own: _T | None, known: _Dated[_T] | None, true_ns: int) -> _T | None:
    """Return the message's own value, or the stored value if it is of nearly the same time."""
    if own is not None or known is None or abs(true_ns - known[0]) > VELOCITY_KEPT_NS:
        return own
    return known[1]


def _differs(before: Reported, message: AdsbVehicle) -> bool:
    pairs = [
        (before.velocity_ne_mps, message.velocity_ne_mps),
        (before.velocity_down_mps, message.velocity_down_mps),
    ]
    if before.alt_datum is message.alt_datum:
        pairs.append((before.alt_m, message.alt_m))
    return any(a is not None and b is not None and a != b for a, b in pairs)


def _rejected(message: AdsbVehicle, reason: Reason, detail: str = "") -> Rejection:
    # Without a position the aircraft cannot be displayed: attribute the message to its relay.
    source = str(message.source) if reason is Reason.NO_POSITION else message.uav
    return Rejection(
        t_ns=message.t_ns, source=source, reason=reason, msgid=ADSB_VEHICLE, detail=detail
    )
