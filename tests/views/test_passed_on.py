"""Forwarded tracks: the present position of each aircraft, with increasing times."""

import math
from typing import Any
from xml.etree import ElementTree

import pymap3d
import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.mavlink.wire.cot import UNKNOWN, from_xml
from companion.mavlink.wire.cot_link import CotSplitter
from companion.mavlink.wire.encode import pack
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.tracking.noise import GEOID_M
from companion.values import Frame, Reason, Rejection, Source, Track
from companion.views import passed_on

S = 1_000_000_000
START_NS = 1_760_000_000 * S
PLACE = (47.4, 8.55, 500.0)
EXACT: dict[str, Any] = {"lag_s": (0.0, 0.0), "acceleration_max_mps2": 5.0, "speed_max_mps": 60.0}


def pipeline(observer: dict[str, Any] | None = None) -> Pipeline:
    known = EXACT | (observer or {})
    sections: dict[str, Any] = {"observer": known, "beams": {"targets": "all"}}
    return Pipeline(Settings().override(center={"source": "47.4,8.55,500"}, **sections))


def there(t_s: float) -> tuple[float, float, float]:
    """Return a position moving north at 20 m/s and east at 15 m/s, 120 m up, 30 km away."""
    lat, lon, alt = pymap3d.ned2geodetic(20 * t_s, 30_000 + 15 * t_s, -120, *PLACE)
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


def telemetry(t_s: float, late_s: float = 0.0, boot_s: float = 100.0) -> Frame:
    lat, lon, alt = there(t_s)
    return framed(t_s + late_s, Source(3, 1), dialect.MAVLink_global_position_int_message(
        round(1000 * (boot_s + t_s)), round(lat * 1e7), round(lon * 1e7), round(alt * 1e3),
        round((alt - 480) * 1e3), 2000, 1500, 0, 3700,
    ))  # fmt: skip


def adsb(t_s: float, datum: int, east_m: float = 0.0) -> Frame:
    lat, lon, alt = pymap3d.ned2geodetic(5 * t_s, east_m, -120, *PLACE)
    return framed(t_s, Source(5, 1), dialect.MAVLink_adsb_vehicle_message(
        0x4CA7B3, round(lat * 1e7), round(lon * 1e7), datum, round(alt * 1e3), 0, 500, 0, b"T",
        0, 1, 1 | 2 | 4 | 8, 0,
    ))  # fmt: skip


def tracks(fold: Pipeline, t_s: float) -> list[Track]:
    now_ns = START_NS + round(t_s * S)
    return fold.tracks(now_ns, now_ns)


def said(fold: Pipeline, t_s: float, out: passed_on.Positions | None = None) -> list[Any]:
    """Return the forwarded messages at a time, as pymavlink reads them."""
    mav: Any = dialect.MAVLink(None)
    messages = (out or passed_on.Positions()).outgoing(fold, tracks(fold, t_s))
    return [mav.decode(bytearray(pack(message, 0))) for message in messages]


def test_vehicle_is_forwarded_at_its_current_position_and_own_time() -> None:
    """0.7 s after its newest report, under its own id and in its own north direction."""
    fold = pipeline()
    for n in range(6):
        fold.step(telemetry(n / 2))
    (one,) = said(fold, 3.2)
    lat, lon, alt = there(3.2)
    assert (one.get_srcSystem(), one.get_srcComponent()) == (3, 1)
    assert one.time_boot_ms == pytest.approx(103_200, abs=5)
    off_m = pymap3d.geodetic2ned(one.lat * 1e-7, one.lon * 1e-7, one.alt * 1e-3, lat, lon, alt)
    assert math.hypot(*off_m) < 0.3
    assert one.relative_alt == pytest.approx((alt - 480) * 1e3, abs=300)
    assert (one.vx, one.vy, one.vz) == (
        pytest.approx(2000, abs=20), pytest.approx(1500, abs=20), pytest.approx(0, abs=20),
    )  # fmt: skip
    assert one.hdg == 3700


@pytest.mark.parametrize("geoid_m", [None, -30.0])
def test_vehicle_is_forwarded_as_utm_global_position(geoid_m: float | None) -> None:
    """Decoded by pymavlink; a height above the ellipsoid only where the geoid is known."""
    fold = pipeline({"geoid_m": geoid_m, "geoid_error_m": 2.0} if geoid_m else None)
    for n in range(6):
        fold.step(telemetry(n / 2))
    (one,) = said(fold, 3.2, passed_on.Positions(utm=True, every_s=0.2))
    assert one.get_type() == "UTM_GLOBAL_POSITION"
    (track,) = tracks(fold, 3.2)
    lat, lon, alt = there(3.2)
    off_m = pymap3d.geodetic2ned(one.lat * 1e-7, one.lon * 1e-7, alt, lat, lon, alt)
    assert math.hypot(*off_m) < 0.3
    assert one.time == (START_NS + 3_200_000_000) // 1000
    assert one.relative_alt == pytest.approx((alt - 480) * 1e3, abs=300)
    assert (one.vx, one.vy) == (pytest.approx(2000, abs=20), pytest.approx(1500, abs=20))
    assert one.h_acc == math.ceil(track.horizontal_bound_m * 1e3)
    assert (one.update_rate, one.vel_acc, bytes(one.uas_id)) == (20, 0, bytes(18))
    known = {
        name.removeprefix("UTM_DATA_AVAIL_FLAGS_").removesuffix("_AVAILABLE")
        for name, value in vars(dialect).items()
        if name.startswith("UTM_DATA_AVAIL_FLAGS_")
        and isinstance(value, int)
        and value <= 128
        and one.flags & value
    }
    has = {"TIME_VALID", "POSITION", "RELATIVE_ALTITUDE", "HORIZONTAL_VELO", "VERTICAL_VELO"}
    assert known == has | ({"ALTITUDE"} if geoid_m else set())
    if geoid_m is None:
        assert one.alt == 0
    else:
        assert one.alt == pytest.approx((alt - 30) * 1e3, abs=300)
        assert one.v_acc == math.ceil((track.vertical_bound_m + 2) * 1e3)


def test_stale_tracks_are_not_forwarded() -> None:
    """A track is stale after 15 s by default."""
    fold = pipeline()
    fold.step(telemetry(0))
    assert len(said(fold, 14)) == len(passed_on.events(fold, tracks(fold, 14), 10)) == 1
    assert said(fold, 16) == passed_on.events(fold, tracks(fold, 16), 10) == []


def test_forwarded_times_increase_except_after_a_reboot() -> None:
    fold, out = pipeline(), passed_on.Positions()
    for n in range(6):
        fold.step(telemetry(n / 2))
    assert len(said(fold, 3.0, out)) == 1
    assert said(fold, 3.0, out) == []
    assert said(fold, 2.9, out) == []
    assert len(said(fold, 3.1, out)) == 1
    for n in range(10, 60):
        fold.step(telemetry(n / 2, boot_s=-4.0))
    (again,) = said(fold, 30.0, out)
    assert again.time_boot_ms == pytest.approx(26_000, abs=5)


def test_late_reports_do_not_move_the_forwarded_position_back() -> None:
    """Every second report is late; the forwarded track continues every 0.2 s."""
    fold, out = pipeline(), passed_on.Positions()
    frames = sorted(
        [telemetry(n / 4, late_s=10.0 if n % 2 else 0.0) for n in range(120)],
        key=lambda frame: frame.t_ns,
    )
    last_ms, north_m = 0, -math.inf
    for n in range(5, 150):
        now_s = n / 5
        while frames and frames[0].t_ns <= START_NS + round(now_s * S):
            fold.step(frames.pop(0))
        (one,) = said(fold, now_s, out)
        assert one.time_boot_ms > last_ms
        lat, lon, alt = there(one.time_boot_ms / 1e3 - 100)
        at_m = pymap3d.geodetic2ned(one.lat * 1e-7, one.lon * 1e-7, one.alt * 1e-3, *PLACE)
        off_m = pymap3d.geodetic2ned(one.lat * 1e-7, one.lon * 1e-7, one.alt * 1e-3, lat, lon, alt)
        assert math.hypot(*off_m) < 0.5
        assert at_m[0] > north_m
        last_ms, north_m = one.time_boot_ms, at_m[0]


def test_cot_event_states_bounds_course_and_speed() -> None:
    """The guaranteed bound, not a standard deviation; plus the geoid error where it applies."""
    fold = pipeline()
    for n in range(6):
        fold.step(telemetry(n / 2))
    (track,) = tracks(fold, 3.2)
    (text,) = passed_on.events(fold, [track], 10.0)
    event = from_xml(text)
    assert event.uid == "uav-companion-beams.3.1" and event.is_aircraft
    assert event.ce_m == pytest.approx(track.horizontal_bound_m, abs=0.06)
    assert event.le_m == pytest.approx(track.vertical_bound_m + GEOID_M, abs=0.06)
    assert (event.course_deg, event.speed_mps) == (
        pytest.approx(math.degrees(math.atan2(15, 20)), abs=0.5), pytest.approx(25, abs=0.3),
    )  # fmt: skip
    root = ElementTree.fromstring(text)
    remarks = root.findtext("detail/remarks")
    assert remarks is not None
    assert "guaranteed bounds, not standard deviations" in remarks and "geoid" in remarks
    assert root.get("time") == root.get("start") == "2025-10-09T08:53:23.200Z"
    assert root.get("stale") == "2025-10-09T08:53:33.200Z"
    contact = root.find("detail/contact")
    assert contact is not None and contact.get("callsign") == "3:1"


@pytest.mark.parametrize("datum", ["telemetry", "geometric"])
def test_heights_are_converted_where_the_geoid_is_known(datum: str) -> None:
    """With the geoid: above mean sea level. Without: above the ellipsoid, with the conversion error
    in the bound."""
    fold = pipeline({"geoid_m": 48.0, "geoid_error_m": 3.0})
    for n in range(6):
        fold.step(telemetry(n / 2) if datum == "telemetry" else adsb(n / 2, 1))
    (track,) = tracks(fold, 3.0)
    alt_m = fold.geodetic(track.position_ned_m[None])[2][0]
    above_sea_m = there(3.0)[2] if datum == "telemetry" else 620.0 - 48.0
    assert alt_m == pytest.approx(above_sea_m, abs=1.0)
    newest = fold.tracker.newest(track.uav)
    assert newest is not None and newest.report.alt_datum == "msl"
    event = from_xml(passed_on.events(fold, [track], 10.0)[0])
    assert event.hae_m == pytest.approx(alt_m + 48.0, abs=0.06)
    assert event.le_m == pytest.approx(track.vertical_bound_m + 3.0, abs=0.06)
    if datum == "geometric":
        bare = pipeline()
        for n in range(6):
            bare.step(adsb(n / 2, 1))
        (other,) = tracks(bare, 3.0)
        assert bare.geodetic(other.position_ned_m[None])[2][0] == pytest.approx(620.0, abs=1.0)
        assert other.vertical_bound_m > track.vertical_bound_m + 100  # 107 m less 3


def test_events_of_a_companion_are_rejected() -> None:
    fold = pipeline()
    fold.step(telemetry(0))
    (text,) = passed_on.events(fold, tracks(fold, 1), 10.0)
    (found,) = CotSplitter("x").feed(7, text)
    assert isinstance(found, Rejection) and found.reason is Reason.UNKNOWN_MESSAGE


@pytest.mark.parametrize(("datum", "told"), [(0, False), (1, True)])
def test_pressure_altitude_is_not_given_as_ellipsoid_height(datum: int, told: bool) -> None:
    fold = pipeline()
    fold.step(adsb(0, datum))
    assert said(fold, 0.5) == []  # it sends no own reports
    (text,) = passed_on.events(fold, tracks(fold, 0.5), 10.0)
    event = from_xml(text)
    assert (event.hae_m is not None, event.le_m is not None) == (told, told)
    assert told or f'hae="{UNKNOWN:.1f}"'.encode() in text
    assert event.uid == "uav-companion-beams.icao.4CA7B3"


def test_aircraft_received_twice_is_forwarded_once() -> None:
    fold = pipeline()
    for n in range(8):
        fold.step(telemetry(n))
        lat, lon, alt = there(n)
        fold.step(framed(n + 0.1, Source(5, 1), dialect.MAVLink_adsb_vehicle_message(
            0x4CA7B3, round(lat * 1e7), round(lon * 1e7), 1, round(alt * 1e3), 3687, 2500, 0, b"T",
            0, 1, 1 | 2 | 4 | 8, 0,
        )))  # fmt: skip
    assert len(tracks(fold, 8)) == 2
    (text,) = passed_on.events(fold, tracks(fold, 8), 10.0)
    assert from_xml(text).uid == "uav-companion-beams.3.1"
