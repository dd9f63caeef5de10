"""Aircraft received by other means than telemetry: merged into one track, with correct times."""

import math
import sys
from collections import Counter
from datetime import UTC, datetime
from typing import Any

import pymap3d
import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.wire.cot_link import CotSplitter
from companion.mavlink.wire.foreign import ForeignSplitter
from companion.mavlink.wire.transponder import AircraftState
from companion.pipeline import records, senders
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Estimate, Frame, Reason, Rejection, Source, Tick, Update
from companion.views.tables.reports import heard

S = 1_000_000_000
RECORDS_MAX = 256
TRACKS_MAX = 100
START_NS = 1_760_000_000 * S
PLACE = (47.4, 8.55, 500.0)
SERIAL = b"1588E0123456789ABCDE"
RID = "rid:1588E0123456789ABCDE"


def pipeline(**sections: dict[str, Any]) -> Pipeline:
    beams = {"targets": "all"}
    return Pipeline(
        Settings().override(center={"source": "47.4,8.55,500"}, beams=beams, **sections)
    )


def there(t_s: float, aside_m: float = 0.0) -> tuple[float, float, float]:
    """Return the aircraft's position: north at 5 m/s, 120 m up."""
    lat, lon, alt = pymap3d.ned2geodetic(300 + 5 * t_s, 40 + aside_m, -120, *PLACE)
    return float(lat), float(lon), float(alt)


def framed(t_s: float, source: Source, message: Any) -> Frame:
    mav = dialect.MAVLink(None, srcSystem=source.sysid, srcComponent=source.compid)
    raw = bytes(message.pack(mav))
    return Frame(
        t_ns=START_NS + round(t_s * S),
        link="udp",
        source=source,
        msgid=message.get_msgId(),
        raw=raw,
    )


def telemetry(t_s: float) -> Frame:
    lat, lon, alt = there(t_s)
    return framed(t_s, Source(1, 1), dialect.MAVLink_global_position_int_message(
        round(1000 * (100 + t_s)), round(lat * 1e7), round(lon * 1e7), round(alt * 1e3), 0,
        500, 0, 0, 65535,
    ))  # fmt: skip


def broadcast(
    t_s: float,
    late_s: float = 0.0,
    receiver: int = 9,
    aside_m: float = 0.0,
    *,
    horizontal: int = 10,
    serial: bytes = SERIAL,
) -> Frame:
    lat, lon, alt = there(t_s, aside_m)
    mac = list(bytes([1, 2, 3, 4, 5, serial[-1] - 63]).ljust(20, b"\0"))
    stamp_s = (START_NS / S + t_s) % 3600
    message = dialect.MAVLink_open_drone_id_location_message(
        0, 0, mac, 2, 0, 500, 0, round(lat * 1e7), round(lon * 1e7), -1000, alt, 0, 0,
        horizontal, 4, 0, 4, stamp_s, 1,
    )  # fmt: skip
    return framed(t_s + late_s, Source(receiver, 236), message)


def naming(t_s: float, receiver: int = 9, serial: bytes = SERIAL) -> Frame:
    mac = list(bytes([1, 2, 3, 4, 5, serial[-1] - 63]).ljust(20, b"\0"))
    message = dialect.MAVLink_open_drone_id_basic_id_message(0, 0, mac, 1, 2, list(serial))
    return framed(t_s, Source(receiver, 236), message)


def transponder(t_s: float, **codes: int) -> Frame:
    lat, lon, alt = there(t_s, 8.0)
    said = AircraftState(
        icao=0x4CA7B3,
        lat_deg=lat,
        lon_deg=lon,
        altitude_ft=alt / 0.3048,
        geometric=True,
        speed_kt=5 * 3600 / 1852,
        track_deg=0.0,
        climb_fpm=0.0,
        **codes,
    )
    (frame,) = ForeignSplitter("readsb")._aircraft(START_NS + round(t_s * S), said)
    assert isinstance(frame, Frame)
    return frame


def event(
    t_s: float, late_s: float = 0.0, ce: float = 5.0, uid: str = "HAWK", aside_m: float = -5.0
) -> Frame:
    lat, lon, hae = there(t_s, aside_m)
    at = datetime.fromtimestamp(START_NS / S + t_s, UTC).isoformat()
    xml = (
        f'<event uid="{uid}" type="a-f-A" time="{at}" how="m-g"><point lat="{lat}" lon="{lon}" '
        f'hae="{hae}" ce="{ce}" le="9"/><detail><track course="0" speed="5" slope="0"/></detail>'
        "</event>"
    )
    (frame,) = CotSplitter("cot").feed(START_NS + round((t_s + late_s) * S), xml.encode())
    assert isinstance(frame, Frame)
    return frame


def updated(fold: Pipeline, t_s: float) -> Update:
    *_, update = fold.step(Tick(START_NS + round(t_s * S)))
    assert isinstance(update, Update)
    return update


def estimates(fold: Pipeline, frame: Frame) -> list[Estimate]:
    return [one for one in fold.step(frame) if isinstance(one, Estimate)]


def test_aircraft_received_three_ways_gets_one_beam() -> None:
    """Telemetry takes precedence over Remote ID, and Remote ID over ADS-B."""
    fold = pipeline()
    fold.step(naming(0))
    for n in range(12):
        fold.step(broadcast(n))
        fold.step(transponder(n + 0.1))
        beams = set(updated(fold, n + 0.2).beams.uavs)
        assert beams == ({RID, "icao:4CA7B3"} if n < 4 else {RID})
    assert fold.targets.identities.same_as("icao:4CA7B3") == RID
    for n in range(12, 24):
        fold.step(telemetry(n))
        fold.step(broadcast(n + 0.05))
        fold.step(transponder(n + 0.1))
    assert set(updated(fold, 24).beams.uavs) == {"1:1"}
    assert (
        fold.targets.identities.same_as(RID)
        == fold.targets.identities.same_as("icao:4CA7B3")
        == "1:1"
    )


def test_cot_event_of_a_tracked_aircraft_is_merged() -> None:
    fold = pipeline()
    for n in range(12):
        fold.step(transponder(n))
        fold.step(event(n))
    assert set(updated(fold, 12).beams.uavs) == {"icao:4CA7B3"}
    assert fold.targets.identities.same_as("cot:HAWK") == "icao:4CA7B3"


def test_work_for_a_relayed_report_does_not_grow_with_the_number_of_aircraft() -> None:
    """A receiver of a thousand aircraft took 2 ms for each report, and vehicles lost frames."""

    def calls(aircraft: int) -> int:
        fold, count = pipeline(), 0
        for number in range(aircraft):
            fold.step(event(0, uid=f"U{number}", aside_m=10.0 * number))
        frame = event(1)

        def seen(_frame: object, what: str, _argument: object) -> None:
            nonlocal count
            count += what in ("call", "c_call")

        sys.setprofile(seen)
        try:
            fold.step(frame)
        finally:
            sys.setprofile(None)
        return count

    assert calls(300) < calls(20) + 100


def test_cot_event_errors_and_delay_are_applied() -> None:
    """Three standard deviations plus the distance flown in one second."""
    fold = pipeline(tracks={"window_s": 20.0})
    assert estimates(fold, event(-1)) == []  # the first is not confirmed
    for n in range(20):
        (heard,) = estimates(fold, event(n))
    assert heard.fix.noise.horizontal_m == pytest.approx(15 + 5, abs=0.1)
    (late,) = estimates(fold, event(9.5, late_s=10.0, ce=9_999_999))
    assert late.fix.noise.horizontal_m == pytest.approx(100 + 5, abs=0.1)
    assert late.fix.t_ns == pytest.approx(START_NS + 9.5 * S, abs=0.2 * S)


@pytest.mark.parametrize("hours", [-1, 1])
def test_old_event_before_others_is_not_used(hours: int) -> None:
    """A server sends old events to each new client: the aircraft was shown where it had been."""
    fold = pipeline()
    wrong = event(3600 * hours, late_s=-3600 * hours)
    assert estimates(fold, wrong) == []
    assert estimates(fold, event(0.2)) == []
    for n in range(1, 10):
        (heard,) = estimates(fold, event(n))
        assert heard.fix.t_ns == pytest.approx(START_NS + n * S, abs=0.1 * S)


def test_late_events_among_others_are_not_used() -> None:
    """A source that is late by 20 s, live, and late again was shown where it had been."""
    fold = pipeline()
    for n in range(3):
        fold.step(event(n))
    for n in range(3, 40):
        late_s = 20.0 if n // 4 % 2 else 0.0
        found = fold.step(event(n - late_s, late_s=late_s))
        assert [type(one) for one in found] == [Rejection if late_s else Estimate]
    for n in range(40, 140):  # late for good, as of a clock that was set back
        found = fold.step(event(n - 20.0, late_s=20.0))
    assert any(isinstance(one, Estimate) for one in found)


def test_distant_aircraft_keeps_its_own_track() -> None:
    fold = pipeline()
    fold.step(naming(0))
    for n in range(12):
        fold.step(telemetry(n))
        fold.step(broadcast(n + 0.05, aside_m=80.0))  # far beyond the error of either
    assert set(updated(fold, 12).beams.uavs) == {"1:1", RID}


def test_broadcast_received_twice_counts_once() -> None:
    fold = pipeline()
    for receiver in (9, 10):
        fold.step(naming(0, receiver))
    for n in range(6):
        assert len(estimates(fold, broadcast(n))) == 1
        (refused,) = fold.step(broadcast(n, late_s=0.3, receiver=10))
        assert isinstance(refused, Rejection) and refused.reason is Reason.DUPLICATE
    assert list(fold.tracker.uavs) == [RID]


def test_position_ten_seconds_late_is_dated_by_its_stamp() -> None:
    """By its stamp, as with telemetry."""
    fold = pipeline(tracks={"window_s": 20.0})
    fold.step(naming(0))
    for n in range(20):
        fold.step(broadcast(n))
    (late,) = estimates(fold, broadcast(9.5, late_s=10.0))
    assert late.fix.t_ns == pytest.approx(START_NS + 9.5 * S, abs=0.2 * S)
    (track,) = fold.tracks(START_NS + 20 * S, START_NS + 20 * S)
    assert track.position_ned_m[0] == pytest.approx(400, abs=3)


@pytest.mark.parametrize("late_s", [0.0, 2.5])
def test_drone_first_received_by_a_late_receiver_may_be_as_late(late_s: float) -> None:
    """It was taken for one in time: 36.7 m off at 24.6 m."""
    fold, other = pipeline(), b"1588E0123456789ABCDF"

    def uncertainty_s(serial: bytes) -> float:
        clock = fold.senders.clock_estimate(f"rid:{serial.decode()}")
        assert clock is not None
        return clock.uncertainty_s

    fold.step(naming(0))
    for n in range(40):
        fold.step(broadcast(n / 2))
    assert uncertainty_s(SERIAL) < 0.3
    for n in range(40, 80):
        t_s = n / 2
        fold.step(broadcast(t_s, late_s))
        if n % 6 == 0 and n >= 60:
            fold.step(naming(t_s + late_s, serial=other))
        fold.step(broadcast(t_s, late_s + 0.01, aside_m=300, serial=other))
    assert late_s <= uncertainty_s(other) < late_s + 0.3


@pytest.mark.parametrize(("code", "horizontal_m"), [(10, 18.5), (9, 55.5), (8, 171.3), (0, 100.0)])
def test_stated_accuracies_set_the_bounds(code: int, horizontal_m: float) -> None:
    """Three times the 68 % radius, plus the distance flown in 0.15 s or, for ADS-B ages, in one
    second."""
    fold = pipeline()
    fold.step(naming(0))
    (heard,) = estimates(fold, broadcast(0, horizontal=code))
    assert heard.fix.noise.horizontal_m == pytest.approx(horizontal_m + 0.15 * 5, abs=0.1)
    (seen,) = estimates(fold, transponder(0, nac_p=code))
    assert seen.fix.noise.horizontal_m == pytest.approx(horizontal_m + 5, abs=0.1)


def test_extra_bytes_of_a_mavlink_relay_are_not_an_accuracy() -> None:
    """Another dialect may have its own fields there; only those of this program's receivers are
    read."""
    theirs = transponder(0, nac_p=11)
    raw = bytearray(theirs.raw)
    raw[5] = 9
    (seen,) = estimates(pipeline(), theirs._replace(source=Source(9, 156), raw=bytes(raw)))
    assert seen.fix.noise.horizontal_m == pytest.approx(105, abs=0.1)


def test_denied_remote_id_is_rejected() -> None:
    fold = pipeline(tracks={"deny": ["rid:*"]})
    fold.step(naming(0))
    (refused,) = fold.step(broadcast(0))
    assert isinstance(refused, Rejection)
    assert (refused.reason, refused.source) == (Reason.NOT_ALLOWED, RID)


def test_broadcast_without_stamp_is_rejected() -> None:
    fold = pipeline()
    fold.step(naming(0))
    message = dialect.MAVLink_open_drone_id_location_message(
        0, 0, list(b"\1\2\3\4\5\6".ljust(20, b"\0")), 2, 0, 0, 0, 474_000_000, 85_500_000, -1000,
        500, 0, 0, 10, 4, 0, 4, 65_535.0, 0,
    )  # fmt: skip
    (refused,) = fold.step(framed(1, Source(9, 236), message))
    assert isinstance(refused, Rejection) and refused.reason is Reason.UNPLACED_STAMP


def test_export_has_a_row_for_every_report_message() -> None:
    fold = pipeline(tracks={"deny": ["cot:*"]})
    found = []
    frames = [broadcast(0), naming(0), broadcast(1), transponder(1), event(1), telemetry(1)]
    mav = dialect.MAVLink(None, srcSystem=9, srcComponent=25)
    other = dialect.MAVLink_tunnel_message(0, 0, 1, 3, [7] * 128)
    frames.append(
        Frame(
            t_ns=START_NS + S,
            link="udp",
            source=Source(9, 25),
            msgid=385,
            raw=bytes(other.pack(mav)),
        )
    )
    for frame in frames:
        found += [heard(frame, fold.step(frame))]
    rows = [(one.uav, one.estimate is not None) for one in found if one is not None]
    assert rows == [
        ("rid:010203040506", False), (RID, True), ("icao:4CA7B3", True), ("cot:HAWK", False),
        ("1:1", True),
    ]  # fmt: skip
    assert all(one.position is not None for one in found if one is not None)


def test_invented_ids_use_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Event ids can be invented freely; the state kept for them is bounded."""
    monkeypatch.setattr(records, "RECORDS_MAX", RECORDS_MAX)
    monkeypatch.setattr(senders, "RECORDS_MAX", RECORDS_MAX)
    fold = pipeline(tracks={"most": TRACKS_MAX})
    template = event(0).raw
    at = template.index(b"HAWK")
    seen: Counter[object] = Counter()
    later = event(1).raw
    for number in range(6 * RECORDS_MAX):
        raw = later if number % 2 else template  # the second confirms the first
        raw = raw[:at] + f"{number // 2:04x}".encode() + raw[at + 4 :]
        for said in fold.step(event(number % 2)._replace(raw=raw)):
            seen[said.reason if isinstance(said, Rejection) else type(said)] += 1
    assert len(fold.senders._senders) <= RECORDS_MAX
    assert len(fold.records) <= RECORDS_MAX
    assert fold.senders._assumed.cache_info().currsize <= RECORDS_MAX
    assert len(fold.tracker.uavs) == seen[Estimate] == TRACKS_MAX
    assert seen[Reason.UNPLACED_STAMP] <= 3 * RECORDS_MAX
    assert seen[Reason.TOO_MANY] + seen[Reason.UNPLACED_STAMP] == 6 * RECORDS_MAX - TRACKS_MAX


def test_invented_remote_ids_use_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(records, "RECORDS_MAX", RECORDS_MAX)
    monkeypatch.setattr(senders, "RECORDS_MAX", RECORDS_MAX)
    fold, refused = pipeline(tracks={"most": TRACKS_MAX}), 0
    for number in range(2 * RECORDS_MAX):
        serial = b"1588E0%013dE" % number
        fold.step(naming(0, serial=serial))
        said = fold.step(broadcast(1, aside_m=number, serial=serial))
        refused += any(isinstance(one, Rejection) and one.reason is Reason.TOO_MANY for one in said)
    assert refused > RECORDS_MAX
    assert len(fold.senders._senders) <= RECORDS_MAX


def summary(t_s: float, **given: int) -> Frame:
    """Return a HIGH_LATENCY2 of the same aircraft, as an autopilot packs it."""
    lat, lon, alt = there(t_s)
    fields = dict.fromkeys(dialect.MAVLink_high_latency2_message.fieldnames, 0)
    fields |= {
        "timestamp": round(1000 * (100 + t_s)), "latitude": round(lat * 1e7),
        "longitude": round(lon * 1e7), "altitude": int(alt), "heading": 0, "groundspeed": 25,
    } | given  # fmt: skip
    return framed(t_s, Source(1, 1), dialect.MAVLink_high_latency2_message(**fields))


def test_uav_with_only_high_latency2_is_tracked_within_its_bound() -> None:
    """One report every 5 s, with height in whole metres and no velocity."""
    into, estimates, t_s = pipeline(), list[Estimate](), 0.0
    for step in range(60):
        t_s = 5.0 * step
        estimates += [one for one in into.step(summary(t_s)) if isinstance(one, Estimate)]
        (track,) = into.tracks(START_NS + round((t_s + 2) * S), START_NS + round((t_s + 2) * S))
        assert into.local is not None
        true = into.local.localise(*there(t_s + 2), None)[0]
        off_m = math.dist(true, track.position_ned_m.tolist())
        assert off_m <= track.bound_m
    assert len(estimates) == 60
    assert track.uav == "1:1" and track.dt_s == pytest.approx(5.0)
    row = heard(summary(t_s), [estimates[-1]])
    assert row is not None and row.message == "HIGH_LATENCY2"


@pytest.mark.parametrize(("eph", "least_m"), [(0, 3.0), (255, 3.0), (80, 24.0)])
def test_high_latency2_bound_includes_its_stated_accuracy(eph: int, least_m: float) -> None:
    """Three times its stated accuracy, plus one metre for the resolution of its heights."""
    (estimate,) = (
        one for one in pipeline().step(summary(0.0, eph=eph)) if isinstance(one, Estimate)
    )
    noise = estimate.fix.noise
    assert noise.horizontal_m == pytest.approx(least_m)
    assert noise.vertical_m == pytest.approx(pipeline_noise_m() + 1.0)
    assert noise.position_m >= math.hypot(noise.horizontal_m, noise.vertical_m) - 1e-9


def pipeline_noise_m() -> float:
    """Return the bound on a height without stated accuracy."""
    (estimate,) = (one for one in pipeline().step(telemetry(0.0)) if isinstance(one, Estimate))
    return estimate.fix.noise.vertical_m
