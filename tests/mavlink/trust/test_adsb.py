"""One stream of reports per aircraft, for any relay and any split into messages.

Messages are packed by pymavlink's generated dialect. The model (``Model``) keeps every message
and derives each result from all of them.
"""

import math
import tracemalloc
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as dialect
from support import examples

from companion.mavlink.trust.adsb import AIRCRAFT_MAX, RELAYS_KEPT, Aircraft
from companion.mavlink.trust.reported_positions import POSITIONS_KEPT
from companion.mavlink.wire.decode import ADSB_VEHICLE, decode
from companion.recording.tlog import read_tlog
from companion.values import AdsbVehicle, AltitudeDatum, Frame, Reason, Rejection, Report, Source

S = 1_000_000_000
EPOCH_NS = 1_700_000_000 * S
UAV = "icao:4CA7B3"
GEOMETRIC, PRESSURE = AltitudeDatum.GEOMETRIC, AltitudeDatum.PRESSURE
HERE, THERE, YONDER = (47.40, 8.55), (47.41, 8.56), (47.42, 8.57)


def said(
    t_s: float,
    at: tuple[float, float] | None = HERE,
    *,
    alt: float | None = None,
    datum: AltitudeDatum = GEOMETRIC,
    velocity: tuple[float, float] | None = None,
    climb: float | None = None,
    callsign: str | None = None,
    tslc: int = 0,
    relay: int = 5,
    icao: int = 0x4CA7B3,
) -> AdsbVehicle:
    """Return a relay's message at a time; ``velocity`` is course (degrees) and speed."""
    flags = sum(
        flag
        for flag, value in (
            (dialect.ADSB_FLAGS_VALID_COORDS, at),
            (dialect.ADSB_FLAGS_VALID_ALTITUDE, alt),
            (dialect.ADSB_FLAGS_VALID_HEADING | dialect.ADSB_FLAGS_VALID_VELOCITY, velocity),
            (dialect.ADSB_FLAGS_VERTICAL_VELOCITY_VALID, climb),
            (dialect.ADSB_FLAGS_VALID_CALLSIGN, callsign),
        )
        if value is not None
    )
    lat, lon = at or (12.0, 34.0)  # fields without their flag are garbage
    course, speed = velocity or (123.0, 45.0)
    message = dialect.MAVLink_adsb_vehicle_message(
        icao, round(lat * 1e7), round(lon * 1e7), int(datum is GEOMETRIC),
        round(1000 * (678.0 if alt is None else alt)), round(100 * course), round(100 * speed),
        round(100 * (9.0 if climb is None else climb)), (callsign or "GARBAGE").encode(),
        dialect.ADSB_EMITTER_TYPE_LIGHT, tslc, flags, 7000,
    )  # fmt: skip
    raw = bytes(message.pack(dialect.MAVLink(None, relay, 1)))
    t_ns = EPOCH_NS + round(t_s * 1e9)
    found = decode(
        Frame(t_ns=t_ns, link=f"udp{relay}", source=Source(relay, 1), msgid=ADSB_VEHICLE, raw=raw)
    )
    assert isinstance(found, AdsbVehicle)
    return found


def report(found: Report | Rejection) -> Report:
    assert isinstance(found, Report), found
    return found


def refused(found: Report | Rejection) -> Reason:
    assert isinstance(found, Rejection), found
    assert (found.count, found.msgid) == (1, ADSB_VEHICLE)
    return found.reason


# --- one message --------------------------------------------------------------------------------


def test_complete_adsb_message_becomes_a_report() -> None:
    message = said(3, alt=500, velocity=(90, 70), climb=-2, callsign="EIN123", tslc=4)
    found = report(Aircraft().merge(message))
    assert found == Report(
        t_ns=message.t_ns, uav=UAV, source=Source(5, 1),
        lat_deg=pytest.approx(47.4), lon_deg=pytest.approx(8.55), alt_m=500.0,
        alt_datum=GEOMETRIC, relative_alt_m=None, velocity_ne_mps=pytest.approx((0, 70)),
        velocity_down_mps=pytest.approx(2.0), heading_deg=pytest.approx(90), boot_ms=None,
        tslc_s=4.0, alt_age_s=0.0,
    )  # fmt: skip


def test_fields_without_valid_flag_are_unknown() -> None:
    found = report(Aircraft().merge(said(0, alt=500, datum=PRESSURE)))
    assert (found.velocity_ne_mps, found.velocity_down_mps, found.heading_deg) == (None,) * 3
    assert found.alt_datum is PRESSURE


def test_rejection_names_the_relay_or_the_aircraft() -> None:
    """A message without a position is attributed to its relay, all others to the aircraft."""
    aircraft = Aircraft()
    assert aircraft.merge(said(1, None, alt=9)) == Rejection(
        t_ns=EPOCH_NS + S, source="5:1", reason=Reason.NO_POSITION, msgid=ADSB_VEHICLE
    )
    aircraft.merge(said(1))
    again = aircraft.merge(said(2))
    assert again == Rejection(
        t_ns=EPOCH_NS + 2 * S, source=UAV, reason=Reason.DUPLICATE, msgid=ADSB_VEHICLE
    )


def test_aircraft_are_kept_separate() -> None:
    aircraft = Aircraft()
    report(aircraft.merge(said(0, alt=500, callsign="ONE")))
    other = said(0.1, icao=0xABCDEF, callsign="TWO")
    assert refused(aircraft.merge(other)) is Reason.NO_ALTITUDE
    assert report(aircraft.merge(replace(other, alt_m=9.0, alt_datum=PRESSURE))).uav == other.uav
    assert (aircraft.callsign(UAV), aircraft.callsign(other.uav)) == ("ONE", "TWO")
    assert (aircraft.datum(UAV), aircraft.datum(other.uav)) == (GEOMETRIC, PRESSURE)


# --- merged by field ----------------------------------------------------------------------------


def test_position_uses_the_newest_altitude_with_its_age() -> None:
    aircraft = Aircraft()
    assert refused(aircraft.merge(said(0, None, alt=500))) is Reason.NO_POSITION
    assert refused(aircraft.merge(said(1, None, alt=510, tslc=1))) is Reason.NO_POSITION
    assert refused(aircraft.merge(said(2, None, alt=490, tslc=3))) is Reason.NO_POSITION  # older
    found = report(aircraft.merge(said(4, tslc=1)))
    assert (found.alt_m, found.alt_age_s) == (510.0, 3.0)
    assert report(aircraft.merge(said(10, THERE))).alt_age_s == 10.0
    assert refused(aircraft.merge(said(10.001, YONDER))) is Reason.NO_ALTITUDE


def test_altitude_age_limit_applies_in_both_directions() -> None:
    aircraft = Aircraft()
    aircraft.merge(said(0, None, alt=500))
    assert refused(aircraft.merge(said(0, tslc=11))) is Reason.NO_ALTITUDE
    assert report(aircraft.merge(said(0, tslc=10))).alt_age_s == 10.0


def test_position_without_altitude_is_used_when_one_arrives() -> None:
    aircraft = Aircraft()
    assert refused(aircraft.merge(said(0))) is Reason.NO_ALTITUDE
    assert refused(aircraft.merge(said(1, tslc=1))) is Reason.NO_ALTITUDE
    aircraft.merge(said(1.5, None, alt=500))
    found = report(aircraft.merge(said(2, tslc=2)))
    assert (found.alt_m, found.alt_age_s, found.tslc_s) == (500.0, 1.5, 2.0)


def test_velocity_applies_only_to_positions_of_the_same_second() -> None:
    """Later the aircraft may have turned, and the velocity's bound would not include that."""
    aircraft = Aircraft()
    aircraft.merge(said(0, None, alt=500, velocity=(180, 60), climb=3))
    found = report(aircraft.merge(said(1)))
    assert found.velocity_ne_mps == pytest.approx((-60, 0))
    assert (found.velocity_down_mps, found.heading_deg) == pytest.approx((-3.0, 180.0))
    found = report(aircraft.merge(said(1.1, THERE)))
    assert (found.velocity_ne_mps, found.velocity_down_mps, found.heading_deg) == (None,) * 3


def test_horizontal_and_vertical_velocity_are_merged_separately() -> None:
    aircraft = Aircraft()
    aircraft.merge(said(0, None, alt=500, velocity=(0, 60)))
    aircraft.merge(said(0.5, None, climb=3))
    found = report(aircraft.merge(said(1.4, THERE)))
    assert found.velocity_ne_mps is None
    assert found.velocity_down_mps == pytest.approx(-3.0)


def test_fields_of_the_message_take_precedence() -> None:
    """Even where a known value is more recent."""
    aircraft = Aircraft()
    aircraft.merge(said(0.9, None, alt=500, velocity=(0, 60), climb=3))
    found = report(aircraft.merge(said(1, alt=400, velocity=(90, 50), climb=-1, tslc=1)))
    assert (found.alt_m, found.alt_age_s) == (400.0, 0.0)
    assert found.velocity_ne_mps == pytest.approx((0, 50))
    assert (found.velocity_down_mps, found.heading_deg) == pytest.approx((1.0, 90.0))
    assert report(aircraft.merge(said(1.1, THERE))).alt_m == 500.0  # and the newer one is kept


def test_newest_callsign_is_kept() -> None:
    aircraft = Aircraft()
    assert aircraft.callsign(UAV) is None
    aircraft.merge(said(0, None, alt=1))
    assert aircraft.callsign(UAV) is None
    aircraft.merge(said(1, None, callsign="NEW"))
    aircraft.merge(said(2, None, callsign="OLD", tslc=2))
    assert aircraft.callsign(UAV) == "NEW"


# --- datums -------------------------------------------------------------------------------------


def test_aircraft_keeps_its_datum_while_fresh() -> None:
    """Two relays, one per datum: no altitude of the other datum enters the track."""
    aircraft = Aircraft()
    for n in range(20):
        place = (47.4 + n / 1000, 8.5)
        if n % 2 == 0:
            found = report(aircraft.merge(said(n, place, alt=500 + n, datum=PRESSURE)))
        else:
            found = report(aircraft.merge(said(n, place, alt=700 + n, relay=6)))
        assert found.alt_datum is aircraft.datum(UAV) is PRESSURE
        assert (found.alt_m, found.alt_age_s) == (500 + n - n % 2, n % 2)


def test_expired_datum_is_replaced_by_the_other() -> None:
    aircraft = Aircraft()
    aircraft.merge(said(0, alt=500, datum=PRESSURE))
    found = report(aircraft.merge(said(10, THERE, alt=700)))
    assert (found.alt_m, found.alt_datum, found.alt_age_s) == (500.0, PRESSURE, 10.0)
    found = report(aircraft.merge(said(10.1, YONDER, alt=700)))
    assert (found.alt_m, found.alt_datum, found.alt_age_s) == (700.0, GEOMETRIC, 0.0)
    assert aircraft.datum(UAV) is GEOMETRIC
    aircraft.merge(said(11, None, alt=505, datum=PRESSURE))  # it returns too late
    assert report(aircraft.merge(said(12, (47.5, 8.5)))).alt_m == 700.0


def test_geometric_altitude_is_preferred() -> None:
    aircraft = Aircraft()
    aircraft.merge(said(0, None, alt=700))
    aircraft.merge(said(5, None, alt=500, datum=PRESSURE))
    found = report(aircraft.merge(said(6)))
    assert (found.alt_m, found.alt_datum, found.alt_age_s) == (700.0, GEOMETRIC, 6.0)
    aircraft = Aircraft()
    aircraft.merge(said(0, None, alt=700))
    found = report(aircraft.merge(said(5, alt=500, datum=PRESSURE)))  # its own altitude is newer
    assert (found.alt_m, found.alt_datum) == (500.0, PRESSURE)


# --- relays, and what they repeat ---------------------------------------------------------------


@pytest.mark.parametrize("relay", [5, 6])
def test_repeated_message_is_a_duplicate_at_any_stated_age(relay: int) -> None:
    """It does not refresh the position, but the relay counts as alive."""
    aircraft = Aircraft()
    aircraft.merge(said(0, alt=500, velocity=(0, 60)))
    for n in range(1, 100):
        again = said(n, alt=500, velocity=(0, 60), tslc=n, relay=relay)
        assert refused(aircraft.merge(again)) is Reason.DUPLICATE
        assert aircraft.relays(UAV)[0] == (relay, 1)
    aircraft = Aircraft()
    aircraft.merge(said(0, alt=500, velocity=(0, 60)))
    for n in range(1, 30):
        again = said(n, alt=500, velocity=(0, 60), relay=relay)  # tslc does not increase
        assert refused(aircraft.merge(again)) is Reason.DUPLICATE
    assert refused(aircraft.merge(said(30, THERE))) is Reason.NO_ALTITUDE


def test_repeated_position_may_add_new_fields() -> None:
    """The new field is dated like the position."""
    aircraft = Aircraft()
    report(aircraft.merge(said(0, alt=500, datum=PRESSURE)))
    more = said(3, alt=700, velocity=(0, 60), callsign="EIN123", relay=6)
    assert refused(aircraft.merge(more)) is Reason.DUPLICATE
    assert aircraft.callsign(UAV) == "EIN123"
    found = report(aircraft.merge(said(0.9, THERE)))
    assert found.velocity_ne_mps == pytest.approx((60, 0))
    assert refused(aircraft.merge(said(10.5, YONDER))) is Reason.NO_ALTITUDE


def test_hovering_aircraft_is_reported_again_after_a_while() -> None:
    aircraft = Aircraft()
    times = (0, 10, 20, 30, 30.1, 40, 60.1, 60.3)
    found = [aircraft.merge(said(t_s, alt=500)) for t_s in times]
    assert [type(each) for each in found] == [
        Report, Rejection, Rejection, Rejection, Report, Rejection, Rejection, Report,
    ]  # fmt: skip


@pytest.mark.parametrize("stated", ["with", "before"])
def test_aircraft_that_states_that_it_hovers_is_reported_every_few_seconds(stated: str) -> None:
    """Some transponders send velocities in messages of their own."""
    aircraft = Aircraft()
    reports = 0
    for n in range(1000):
        t_s = n / 10
        with_it: dict[str, Any] = {"velocity": (90, 0.5), "climb": 0.5} if stated == "with" else {}
        if stated == "before":
            aircraft.merge(said(t_s, None, velocity=(90, 0.5)))
        reports += type(aircraft.merge(said(t_s, alt=500, **with_it))) is Report
    assert reports == 33  # every 3.1 s


@pytest.mark.parametrize("climb", [0.0, 0.9])
def test_aircraft_that_moves_slowly_is_not_taken_for_one_that_hovers(climb: float) -> None:
    aircraft = Aircraft()
    moves: dict[str, Any] = {"velocity": (45, 1.1 - climb / 2), "climb": climb}
    report(aircraft.merge(said(0, alt=500, **moves)))
    assert refused(aircraft.merge(said(29, alt=500, **moves))) is Reason.DUPLICATE


def test_hover_that_a_lagging_relay_still_states_is_a_duplicate() -> None:
    aircraft = Aircraft()
    report(aircraft.merge(said(0, alt=500, velocity=(0, 0))))
    for n in range(1, 10):
        report(aircraft.merge(said(n, (47.5, 8.5 + n / 100), alt=500, velocity=(0, 5))))
        late = said(n + 0.5, alt=500, velocity=(0, 0), relay=6)
        assert refused(aircraft.merge(late)) is Reason.DUPLICATE


def test_hovering_aircraft_whose_position_flips_is_reported_every_few_seconds() -> None:
    """To the next value of its resolution, and back."""
    aircraft, times = Aircraft(), list[float]()
    for n in range(1000):
        at = (47.40005, 8.55) if n % 300 == 150 else HERE
        if type(aircraft.merge(said(n / 10, at, alt=500, velocity=(0, 0)))) is Report:
            times.append(n / 10)
    assert max(b - a for a, b in pairwise(times)) < 3.2


@pytest.mark.parametrize(
    "moved", [{"alt": 501.0}, {"climb": 2.0}, {"velocity": (0.0, 61.0)}, {"at": THERE}]
)
def test_moving_aircraft_is_reported_at_once(moved: dict[str, object]) -> None:
    """A balloon rises over one place."""
    aircraft = Aircraft()
    same: dict[str, object] = {"alt": 500.0, "climb": 1.0, "velocity": (0.0, 60.0), "at": HERE}
    for t_s, words in ((0.0, same), (0.5, same | moved)):
        report(aircraft.merge(said(t_s, **words)))  # type: ignore[arg-type]


def test_lagging_relay_messages_are_duplicates() -> None:
    aircraft = Aircraft()
    places = [(47.4 + n / 1000, 8.5) for n in range(POSITIONS_KEPT)]
    for n, place in enumerate(places):
        report(aircraft.merge(said(n / 2, place, alt=500)))
    for n, place in enumerate(places):  # its messages claim to be new
        late = said(16 + n / 2, place, alt=500, relay=6)
        assert refused(aircraft.merge(late)) is Reason.DUPLICATE


def test_repeated_position_is_remembered_from_its_last_report() -> None:
    aircraft = Aircraft()
    report(aircraft.merge(said(0, alt=500)))
    for n in range(1, POSITIONS_KEPT):
        report(aircraft.merge(said(n / 10, (47.5, 8.5 + n / 1000), alt=500)))
    report(aircraft.merge(said(5, alt=600)))  # back, and higher
    for n in range(1, POSITIONS_KEPT):
        report(aircraft.merge(said(6 + n / 10, (47.6, 8.5 + n / 1000), alt=600)))
    assert refused(aircraft.merge(said(10, alt=600))) is Reason.DUPLICATE


def test_certainly_older_message_is_out_of_order() -> None:
    aircraft = Aircraft()
    report(aircraft.merge(said(10, HERE, alt=500, tslc=2)))
    older = aircraft.merge(said(11, THERE, alt=480, tslc=4, relay=6))
    assert refused(older) is Reason.OUT_OF_ORDER
    assert (
        isinstance(older, Rejection)
        and older.detail == "1.0 s older than the newest message of this aircraft"
    )
    report(aircraft.merge(said(11.001, YONDER, alt=490, tslc=4, relay=6)))  # may be the newer
    assert refused(aircraft.merge(said(11.002, THERE, alt=480, tslc=5))) is Reason.OUT_OF_ORDER


def test_reports_within_the_slack_do_not_move_the_newest_back() -> None:
    """Each is half a second older than the previous one; all are compared with the newest."""
    aircraft = Aircraft()
    report(aircraft.merge(said(10, (47.4, 8.5), alt=500)))
    report(aircraft.merge(said(10.5, (47.5, 8.5), alt=500, tslc=1)))
    assert refused(aircraft.merge(said(11, (47.6, 8.5), alt=500, tslc=2))) is Reason.OUT_OF_ORDER


def test_relays_are_listed_newest_first() -> None:
    aircraft = Aircraft()
    assert aircraft.relays(UAV) == ()
    aircraft.merge(said(0, relay=1, alt=500))
    aircraft.merge(said(1, None, relay=2))
    aircraft.merge(said(2, relay=3, tslc=2))  # a duplicate
    aircraft.merge(said(3, relay=4, tslc=255))  # unusable
    aircraft.merge(said(4, relay=1, tslc=4))
    assert [relay.sysid for relay in aircraft.relays(UAV)] == [1, 4, 3, 2]
    aircraft.merge(said(90, THERE, relay=3, alt=500))
    aircraft.merge(said(123, YONDER, relay=3, alt=500))
    assert [relay.sysid for relay in aircraft.relays(UAV)] == [3, 1, 4]


# --- expiry -------------------------------------------------------------------------------------


def test_aircraft_is_forgotten_after_two_minutes() -> None:
    aircraft = Aircraft()
    aircraft.merge(said(0, alt=500, callsign="EIN123"))
    for t_s in (30, 60, 90, 119):
        assert refused(aircraft.merge(said(t_s, alt=500, tslc=t_s))) is Reason.DUPLICATE
    other = said(120, icao=1, alt=1)
    aircraft.merge(other)
    assert aircraft.callsign(UAV) == "EIN123"
    aircraft.merge(replace(other, t_ns=other.t_ns + 1))
    assert aircraft.callsign(UAV) is None
    assert aircraft.datum(UAV) is None
    assert aircraft.relays(UAV) == ()


@pytest.mark.parametrize("tslc", [120, 255])
def test_message_older_than_two_minutes_is_out_of_order(tslc: int) -> None:
    aircraft = Aircraft()
    assert refused(aircraft.merge(said(0, alt=500, tslc=tslc))) is Reason.OUT_OF_ORDER
    assert aircraft.relays(UAV) == ()
    report(aircraft.merge(said(0, alt=500, tslc=119)))
    assert refused(aircraft.merge(said(1, None, alt=600, tslc=tslc))) is Reason.OUT_OF_ORDER


def traced_bytes() -> int:
    """Return the memory that this room holds.

    The interpreter's table of interned strings, which ``values/names.py`` adds to, grows in steps
    of megabytes whenever a process has enough of them.
    """
    room = [tracemalloc.Filter(True, "*/mavlink/*.py")]
    found = tracemalloc.take_snapshot().filter_traces(room)
    return sum(one.size for one in found.statistics("filename"))


def test_number_of_aircraft_is_bounded() -> None:
    """The least recently updated is evicted; one with updates stays."""
    aircraft = Aircraft()
    first = said(0, alt=500, icao=1)
    template = said(0, alt=500)
    aircraft.merge(first)
    sizes = []
    tracemalloc.start()
    try:
        for n in range(2, 4 * AIRCRAFT_MAX):
            t_ns = EPOCH_NS + n * 1000
            aircraft.merge(replace(template, t_ns=t_ns, icao=n))
            if n % 500 == 0:
                place = (47.0 + n / 1e6, 8.0)
                report(aircraft.merge(replace(first, t_ns=t_ns, position_deg=place)))
            if n in (2 * AIRCRAFT_MAX, 4 * AIRCRAFT_MAX - 1):
                sizes.append(traced_bytes())
    finally:
        tracemalloc.stop()
    assert sizes[1] < 1.05 * sizes[0]
    known = [n for n in range(1, 4 * AIRCRAFT_MAX) if aircraft.relays(f"icao:{n:06X}")]
    assert known == [1, *range(3 * AIRCRAFT_MAX + 1, 4 * AIRCRAFT_MAX)]


def test_memory_per_aircraft_is_bounded() -> None:
    aircraft = Aircraft()
    template = said(0, alt=500)
    for n in range(200):
        new = replace(
            template,
            t_ns=EPOCH_NS + n * S,
            position_deg=(47.0 + n / 1000, 8.0),
            source=Source(n, 1),
        )
        report(aircraft.merge(new))
    assert len(aircraft.relays(UAV)) == RELAYS_KEPT
    kept = []
    for n in range(200):
        again = replace(template, t_ns=EPOCH_NS + 200 * S, position_deg=(47.0 + n / 1000, 8.0))
        found = aircraft.merge(replace(again, tslc_s=40))
        if refused(found) is Reason.DUPLICATE:
            kept.append(n)
    assert kept == list(range(200 - POSITIONS_KEPT, 200))


# --- against the brute-force model --------------------------------------------------------------


class Model:
    """One aircraft by brute force: every message is kept, and each result derived from all."""

    def __init__(self) -> None:
        self.learned: list[tuple[int, AdsbVehicle]] = []  # time of validity
        self.reports: list[AdsbVehicle] = []
        self.heard: list[AdsbVehicle] = []
        self.datum: AltitudeDatum | None = None
        self.news_ns = 0

    def newest(self, value: Callable[[AdsbVehicle], object]) -> tuple[int, object] | None:
        said = [(t, n, value(m)) for n, (t, m) in enumerate(self.learned) if value(m) is not None]
        if not said:
            return None
        t_ns, _, found = max(said, key=lambda each: each[:2])
        return t_ns, found

    def altitude(self, datum: AltitudeDatum) -> tuple[int, object] | None:
        return self.newest(lambda m: m.alt_m if m.alt_datum is datum else None)

    def merge(self, m: AdsbVehicle) -> Reason | dict[str, object]:
        if m.t_ns - self.news_ns > 120 * S:
            Model.__init__(self)
        known = bool(self.learned)
        if known or m.tslc_s < 120:
            self.heard.append(m)
        if m.tslc_s >= 120:
            return Reason.OUT_OF_ORDER
        then_ns = m.t_ns - m.tslc_s * S
        for before in [r for r in self.reports if m.position_deg and at(r) == at(m)][-1:]:
            was_ns = before.t_ns - before.tslc_s * S
            wait_s = 3 if self.states_hover(m, then_ns) else 30
            hovers = m.t_ns > before.t_ns + wait_s * S and then_ns >= was_ns + S
            if not hovers and not disagree(before, m):
                self.learned.append((was_ns, m))
                return Reason.DUPLICATE
        self.learned.append((then_ns, m))
        self.news_ns = m.t_ns
        if m.position_deg is None:
            return Reason.NO_POSITION
        if any(then_ns <= r.t_ns - r.tslc_s * S - S for r in self.reports):
            return Reason.OUT_OF_ORDER
        for datum in [self.datum, m.alt_datum, GEOMETRIC, PRESSURE]:
            own = m.alt_datum is datum
            known_alt = (then_ns, m.alt_m) if own else datum and self.altitude(datum)
            if datum and known_alt and abs(then_ns - known_alt[0]) <= 10 * S:
                self.datum = datum
                self.reports.append(m)
                return {
                    "alt_m": known_alt[1],
                    "alt_datum": datum,
                    "alt_age_s": pytest.approx(abs(then_ns - known_alt[0]) / 1e9),
                    "velocity_ne_mps": self.fitting(m, then_ns, "velocity_ne_mps"),
                    "velocity_down_mps": self.fitting(m, then_ns, "velocity_down_mps"),
                    "heading_deg": self.fitting(m, then_ns, "heading_deg"),
                    "uav": m.uav,
                    "t_ns": m.t_ns,
                    "source": m.source,
                    "tslc_s": m.tslc_s,
                }
        return Reason.NO_ALTITUDE

    def fitting(self, m: AdsbVehicle, then_ns: int, name: str) -> object:
        if getattr(m, name) is not None:
            return getattr(m, name)
        known = self.newest(lambda each: getattr(each, name))
        return known[1] if known and abs(known[0] - then_ns) <= S else None

    def states_hover(self, m: AdsbVehicle, then_ns: int) -> bool:
        for _, known in self.learned:
            speed = math.hypot(*(known.velocity_ne_mps or (0, 0)), known.velocity_down_mps or 0)
            if speed > 1.0 and m.t_ns - known.t_ns <= 3 * S:
                return False
        north_east = self.fitting(m, then_ns, "velocity_ne_mps")
        down: Any = self.fitting(m, then_ns, "velocity_down_mps")
        return isinstance(north_east, tuple) and math.hypot(*north_east, down or 0.0) <= 1.0

    def relays(self) -> tuple[Source, ...]:
        if not self.heard:
            return ()
        last = {m.source: (m.t_ns, n) for n, m in enumerate(self.heard)}
        recent = [s for s in last if self.heard[-1].t_ns - last[s][0] <= 120 * S]
        return tuple(sorted(recent, key=lambda s: last[s], reverse=True))


def at(m: AdsbVehicle) -> tuple[float, float] | None:
    return m.position_deg


def disagree(a: AdsbVehicle, b: AdsbVehicle) -> bool:
    names = ["velocity_ne_mps", "velocity_down_mps"]
    if a.alt_datum is b.alt_datum:
        names.append("alt_m")
    values = [(getattr(a, name), getattr(b, name)) for name in names]
    return any(x != y for x, y in values if x is not None and y is not None)


STEPS = st.sampled_from([0.0, 0.25, 0.5, 1.0, 1.0, 2.0, 4.5, 9.75, 31.0, 119.0, 121.0])
MESSAGES = st.fixed_dictionaries(
    {
        "at": st.sampled_from([None, HERE, THERE, YONDER, (47.5, 8.0), (47.6, 8.0)]),
        "alt": st.sampled_from([None, None, 500.0, 510.0]),
        "datum": st.sampled_from([GEOMETRIC, PRESSURE]),
        "velocity": st.sampled_from([None, (0.0, 60.0), (90.0, 70.0), (90.0, 0.0)]),
        "climb": st.sampled_from([None, 0.0, 3.0]),
        "callsign": st.sampled_from([None, "ONE", "TWO"]),
        "tslc": st.sampled_from([0, 0, 0, 1, 1, 2, 3, 11, 119, 120]),
        "relay": st.integers(1, 3),
        "icao": st.sampled_from([1, 1, 1, 2]),
    }
)


@pytest.mark.full
@settings(max_examples=examples(400), deadline=None)
@given(st.lists(st.tuples(STEPS, MESSAGES), max_size=30))
def test_merging_matches_the_brute_force_model(flow: list[tuple[float, dict[str, object]]]) -> None:
    aircraft, models = Aircraft(), {1: Model(), 2: Model()}
    t_s = 0.0
    for step_s, words in flow:
        t_s += step_s
        message = said(t_s, **words)  # type: ignore[arg-type]
        model = models[message.icao]
        expected, found = model.merge(message), aircraft.merge(message)
        if isinstance(expected, Reason):
            assert refused(found) is expected
        else:
            made = report(found)
            assert (made.lat_deg, made.lon_deg) == message.position_deg
            assert {name: getattr(made, name) for name in expected} == expected
        assert aircraft.datum(message.uav) is model.datum
        callsign = model.newest(lambda m: m.callsign)
        assert aircraft.callsign(message.uav) == (callsign and callsign[1])
        assert aircraft.relays(message.uav) == model.relays()


# --- recordings ---------------------------------------------------------------------------------


def merged(log: bytes) -> tuple[list[Report], Counter[Reason], int]:
    """Return reports, rejections, and the number of messages."""
    aircraft, reports, lost = Aircraft(), [], Counter[Reason]()
    count = 0
    for event in read_tlog(log, "x"):
        if isinstance(event, Frame) and event.msgid == ADSB_VEHICLE:
            message = decode(event)
            assert isinstance(message, AdsbVehicle)
            count += 1
            match aircraft.merge(message):
                case Report() as found:
                    reports.append(found)
                case Rejection(reason=reason):
                    lost[reason] += 1
    return reports, lost, count


def test_airliner_recording_is_merged(shared_log: Callable[[str], bytes]) -> None:
    """Every message is new at airliner speed."""
    reports, lost, count = merged(shared_log("adsb_pymodes_real.tlog"))
    assert (len(reports) + lost.total(), count) == (933, 933)
    assert lost.total() < 10
    assert {found.alt_datum for found in reports} == {PRESSURE}
    assert all(found.alt_age_s == 0.0 and found.velocity_ne_mps for found in reports)


def test_simulated_traffic_is_merged(cut_log: bytes) -> None:
    reports, lost, count = merged(cut_log)
    assert len(reports) + lost.total() == count == 125
    assert len(reports) > 50
    for name in {found.uav for found in reports}:
        own = [(found.lat_deg, found.lon_deg) for found in reports if found.uav == name]
        assert all(a != b for a, b in pairwise(own))


def test_second_relay_does_not_change_the_reports(cut_log: bytes) -> None:
    aircraft, reports = Aircraft(), []
    for event in read_tlog(cut_log, "x"):
        if isinstance(event, Frame) and event.msgid == ADSB_VEHICLE:
            message = decode(event)
            assert isinstance(message, AdsbVehicle)
            reports.append(aircraft.merge(message))
            echo = replace(message, t_ns=message.t_ns + 1000, source=Source(77, 1))
            assert refused(aircraft.merge(echo)) is Reason.DUPLICATE
            assert aircraft.relays(message.uav) == (Source(77, 1), message.source)
    assert [found for found in reports if isinstance(found, Report)] == merged(cut_log)[0]
