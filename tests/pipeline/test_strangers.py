"""Unknown senders with arbitrary traffic: they evict no tracked UAV, and all state is bounded."""

import math
import random
from collections.abc import Callable, Container

import numpy as np
import pytest
from pymavlink.dialects.v20 import common
from sent_frames import position

from companion.mavlink.trust.admission import KNOWN_MAX, admission
from companion.pipeline.center import CarrierTracker
from companion.pipeline.fold import Pipeline
from companion.pipeline.records import DROPPED_TOGETHER, RECORDS_MAX, Records, UavRecord
from companion.pipeline.senders import PlacedAttitude, Senders
from companion.settings.model import Settings
from companion.tracking.observers.position import PositionModel, PositionObserver
from companion.tracking.tracker import ESTABLISHED, Tracker, TrackerSettings
from companion.values import (
    AltitudeDatum,
    Attitude,
    Cause,
    Estimate,
    Fix,
    Frame,
    Limits,
    Reason,
    Rejection,
    Report,
    ReportNoise,
    Source,
    Tick,
    Update,
)

S = 1_000_000_000
MS = 1_000_000


# --- table of tracks ----------------------------------------------------------------------------


def fix(uav: str, t_s: float) -> Fix:
    t_ns = round(t_s * S)
    report = Report(
        t_ns=t_ns,
        uav=uav,
        source=Source(1, 1),
        lat_deg=47.0,
        lon_deg=8.0,
        alt_m=500.0,
        alt_datum=AltitudeDatum.MSL,
        relative_alt_m=None,
        velocity_ne_mps=None,
        velocity_down_mps=None,
        heading_deg=None,
        boot_ms=1000,
        tslc_s=None,
    )
    place = (10.0 * t_s, 0.0, -50.0)
    noise = ReportNoise(horizontal_m=1.2, vertical_m=0.9, position_m=1.5, velocity_mps=0.4)
    return Fix(
        uav=uav,
        sender_ns=t_ns,
        t_ns=t_ns,
        arrival_ns=t_ns,
        position_ned_m=place,
        velocity_ned_mps=None,
        noise=noise,
        report=report,
    )


@pytest.fixture
def tracker() -> Tracker:
    observer = PositionObserver(
        PositionModel(speed_max_mps=30.0, acceleration_max_mps2=8.0, alpha=0.5)
    )
    return Tracker(observer, TrackerSettings(limits=Limits(30.0, 8.0), most=10))


def flown(tracker: Tracker, uav: str, reports: int, from_s: float) -> None:
    for number in range(reports):
        assert isinstance(tracker.accept(fix(uav, from_s + number * 0.1))[0], Estimate)


def test_strangers_do_not_evict_a_tracked_uav(tracker: Tracker) -> None:
    flown(tracker, "1:1", ESTABLISHED, 0.0)
    tracker.forget("1:1")  # silent behind a hill for ten minutes
    for number in range(10):
        flown(tracker, f"200:{number}", 3, 700.0)
    refused = tracker.accept(fix("201:1", 701.0))[0]
    assert isinstance(refused, Rejection)
    assert refused.reason is Reason.TOO_MANY
    assert isinstance(tracker.accept(fix("1:1", 702.0))[0], Estimate)
    assert tracker.uavs == [*(f"200:{number}" for number in range(9)), "1:1"]


def test_long_tracked_uavs_are_not_evicted(tracker: Tracker) -> None:
    flown(tracker, "1:1", ESTABLISHED, 0.0)
    tracker.forget("1:1")
    for number in range(10):
        flown(tracker, f"2:{number}", ESTABLISHED, 700.0)
    assert isinstance(tracker.accept(fix("1:1", 710.0))[0], Rejection)


def test_rejected_strangers_leave_no_state(tracker: Tracker) -> None:
    for number in range(10):
        flown(tracker, f"2:{number}", 1, 0.0)
    for number in range(1000):
        assert isinstance(tracker.accept(fix(f"icao:{number:06X}", 1.0))[0], Rejection)
    assert len(tracker._tracked) == 10


def test_stale_strangers_make_room(tracker: Tracker) -> None:
    """Invented ids with a few reports each kept others out for ten minutes."""
    for number in range(9):
        flown(tracker, f"200:{number}", 2, 0.0)
    flown(tracker, "2:1", ESTABLISHED, 0.0)
    for t_s in (6.0, 14.0):
        assert isinstance(tracker.accept(fix("1:1", t_s))[0], Rejection)
    assert isinstance(tracker.accept(fix("1:1", 16.0))[0], Estimate)
    assert tracker.uavs == ["2:1", "1:1"]


def test_stale_tracks_are_not_searched_for_at_each_report(
    tracker: Tracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(10):
        flown(tracker, f"2:{number}", 1, 0.0)
    searched = list[int]()

    def silent(now_ns: int, for_s: float) -> list[str]:
        searched.append(now_ns)
        return []

    monkeypatch.setattr(tracker, "silent", silent)
    for number in range(1000):
        tracker.accept(fix(f"icao:{number:06X}", 1.0 + number * 1e-3))
    assert len(searched) == 1


def test_established_set_is_bounded_by_the_track_limit(tracker: Tracker) -> None:
    for number in range(30):
        flown(tracker, f"3:{number}", ESTABLISHED, 100.0 * number)
        tracker.forget(f"3:{number}")
    assert tracker._established == {f"3:{number}" for number in range(10)}  # the first ones


def test_admission_cache_is_bounded() -> None:
    admits = admission(("1:*", "icao:4*"), ("1:7",))
    for number in range(3 * KNOWN_MAX):
        assert admits(f"icao:{number:06X}") is (f"{number:06X}"[0] == "4")
    assert admits.cache_info().currsize == KNOWN_MAX  # type: ignore[attr-defined]
    assert [admits(uav) for uav in ("1:1", "1:7", "2:1")] == [True, False, False]


def new_senders(carrier: str | None, tracked: Container[str]) -> Senders:
    return Senders(
        settings=Settings(),
        carrier=carrier,
        records=Records(UavRecord, tracked.__contains__),
        tracked=tracked,
    )


def test_clocks_are_evicted_except_those_of_tracks() -> None:
    tracked = {str(Source(number, 1)) for number in range(0, 200, 10)}
    senders = new_senders("255:1", tracked)
    for number in range(RECORDS_MAX + 2 * DROPPED_TOGETHER):
        source = Source(255 - number % 256, 1 + number // 256)
        senders.hear(position(2.0, str(source)))
        assert len(senders._senders) <= RECORDS_MAX
    assert tracked | {"255:1"} <= senders._senders.keys()
    assert str(source) in senders._senders


def test_every_track_keeps_its_clock_beyond_the_limit() -> None:
    class Everyone:
        asked = 0

        def __contains__(self, name: object) -> bool:
            self.asked += 1
            return True

    everyone = Everyone()
    senders = new_senders(None, everyone)
    many = RECORDS_MAX + 3 * DROPPED_TOGETHER
    for number in range(many):
        senders.hear(position(2.0, str(Source(number % 256, number // 256))))
    assert len(senders._senders) == many
    assert everyone.asked < 4 * many  # the table is not scanned for each new sender


def test_component_records_are_evicted() -> None:
    senders = new_senders("5:1", {"1:1"})
    mav = common.MAVLink(None)

    def heard(number: int) -> None:
        source = Source(1 + number % 250, 1 + number // 250)
        mav.srcSystem, mav.srcComponent = source
        gnss = common.MAVLink_gps_raw_int_message(S, 3, 0, 0, 0, 0, 0, 0, 0, 9)
        for message in (gnss, common.MAVLink_heartbeat_message(2, 3, 128, 0, 4, 3)):
            raw = message.pack(mav, force_mavlink1=True)
            senders.hear(
                Frame(t_ns=S, link="udp", source=source, msgid=message.get_msgId(), raw=raw)
            )

    for number in range(RECORDS_MAX + 100):
        heard(number)
    assert len(senders._components) == RECORDS_MAX + 100
    senders.forget_silent(2 * S)
    assert (
        len(senders._components) == RECORDS_MAX + 2
    )  # the oldest are evicted, except those that are kept
    assert {str(source) for source in list(senders._components)[:3]} == {"1:1", "5:1", "101:1"}
    senders.forget_silent(4000 * S)
    assert set(map(str, senders._components)) == {"1:1", "5:1"}


def test_records_of_invented_ids_are_bounded() -> None:
    records = Records(UavRecord, {"0:1"}.__contains__)
    for number in range(3 * RECORDS_MAX):
        records[f"{number}:1"].refuted += 1
        assert len(records) <= RECORDS_MAX
    assert records["0:1"].refuted == 1
    assert records.get(f"{RECORDS_MAX}:1") is None


# --- attitudes of the carrier -------------------------------------------------------------------


def attitude(arrival_ms: int, stamp_ms: int, yaw_rad: float) -> PlacedAttitude:
    said = Attitude(
        t_ns=arrival_ms * MS,
        source=Source(5, 1),
        boot_ms=stamp_ms,
        roll_rad=0.0,
        pitch_rad=0.0,
        yaw_rad=yaw_rad,
        rollspeed_radps=0.0,
        pitchspeed_radps=0.0,
        yawspeed_radps=0.0,
    )
    return PlacedAttitude(said, stamp_ms * MS)


@pytest.fixture
def turning() -> Callable[[list[PlacedAttitude]], list[float]]:
    """Return ``turning(attitudes)``: the known yaw after each attitude, in degrees."""

    def run(attitudes: list[PlacedAttitude]) -> list[float]:
        center = CarrierTracker(Settings().override(center={"source": "5:1"}))
        known = []
        for one in attitudes:
            center.turn(one, 40.0)
            assert center._attitude is not None
            known.append(round(math.degrees(center._attitude[1].yaw_rad), 3))
        return known

    return run


def yaw_rad(ms: int) -> float:
    return math.radians(ms / 100)


def test_attitude_with_a_future_stamp_does_not_block_later_ones(
    turning: Callable[[list[PlacedAttitude]], list[float]],
) -> None:
    honest = [attitude(t, t, yaw_rad(t)) for t in range(0, 5000, 100)]
    forged = attitude(1050, 61_050, math.pi)
    said = sorted([*honest, forged], key=lambda one: one.attitude.t_ns)
    known = turning(said)
    assert known[11] == 180.0
    locked_ms = [
        one.attitude.t_ns // MS for one, yaw in zip(said, known, strict=True) if yaw == 180
    ]
    assert locked_ms[-1] - locked_ms[0] <= 600
    assert known[-1] == pytest.approx(math.degrees(yaw_rad(4900)))


def test_slower_link_does_not_revert_the_attitude(
    turning: Callable[[list[PlacedAttitude]], list[float]],
) -> None:
    """Attitudes arrive again two seconds late at their own rate, beside the fresh ones."""
    rng = random.Random(5)
    fast = [attitude(t, t, yaw_rad(t)) for t in range(0, 20_000, 100)]
    slow = [attitude(t + 2000 + rng.randrange(90), t, yaw_rad(t)) for t in range(0, 18_000, 40)]
    known = turning(sorted([*fast, *slow], key=lambda one: one.attitude.t_ns))
    assert np.all(np.diff(known) >= 0)


def test_burst_of_resent_attitudes_does_not_revert_the_attitude(
    turning: Callable[[list[PlacedAttitude]], list[float]],
) -> None:
    fresh = [attitude(t, t, yaw_rad(t)) for t in range(0, 3000, 100)]
    burst = [attitude(3000 + t // 1000, t, yaw_rad(t)) for t in range(0, 2900, 50)]
    assert set(turning([*fresh, *burst])[-len(burst) :]) == {29.0}


# --- limit on beams -------------------------------------------------------------------------------


def report(sysid: int, t_s: float) -> Frame:
    """Return a report of a UAV that hovers in its own direction from the array."""
    mav = common.MAVLink(None, srcSystem=sysid, srcComponent=1)
    angle, t_ms = sysid / 10, round(t_s * 1000)
    lat, lon = 47.0 + 0.002 * math.cos(angle), 8.0 + 0.003 * math.sin(angle)
    message = common.MAVLink_global_position_int_message(
        t_ms, round(lat * 1e7), round(lon * 1e7), 500_000, 0, 0, 0, 0, 0
    )
    return Frame(
        t_ns=round(t_s * S) + 3 * MS,
        link="udp",
        source=Source(sysid, 1),
        msgid=33,
        raw=message.pack(mav),
    )


def test_beams_go_to_first_uavs_and_to_priority_uavs() -> None:
    """However many arrive; a lost UAV frees its place, and all others get a reason."""
    given = {"center": {"source": "47,8,480,0"}, "beams": {"most": 3, "priority": ["90:1"]}}
    pipeline = Pipeline(Settings().override(**given))

    def flies(from_s: float, to_s: float, sysids: list[int]) -> Update:
        for tenth in range(round(10 * from_s), round(10 * to_s)):
            for sysid in sysids:
                pipeline.step(report(sysid, tenth / 10))
            pipeline.step(Tick(tenth * 100 * MS + 50 * MS))
        assert pipeline.last_update is not None
        return pipeline.last_update

    assert flies(1, 3, [1, 2, 3]).beams.uavs == ("1:1", "2:1", "3:1")
    update = flies(3, 5, [*range(1, 41), 90])
    assert update.beams.uavs == ("1:1", "2:1", "90:1")
    assert {out.uav for out in update.beams.left_out} == {f"{n}:1" for n in range(3, 41)}
    assert {out.reason for out in update.beams.left_out} == {
        "limit of 3 UAVs with beams is reached"
    }
    assert {out.cause for out in update.beams.left_out} == {Cause.MACHINE}
    assert pipeline.health.verdicts["7:1"].blame is not None
    update = flies(5, 70, [*range(2, 41), 90])  # 1:1 has left
    assert update.beams.uavs == ("2:1", "3:1", "90:1")
