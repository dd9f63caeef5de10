"""Assumptions about aircraft, and the notices when reports refute them, in the whole pipeline."""

import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import pymavlink.dialects.v20.all as dialect
import pytest

from companion import Frame, Pipeline, RoundTrip, Settings, Source, Tick
from companion.mavlink.clock.estimates import ClockChange
from companion.pipeline.assumptions import ClockNotices
from companion.values import Estimate, Notice, Output, Reason, Refuted, Rejection, Severity, Update

START_NS = 1_760_000_000_000_000_000
S = 1_000_000_000
LAT, LON, ALT_M = 47.4, 8.55, 500.0
M_PER_DEG = 111_195.0


def sent(t_s: float, source: str, message: Any) -> Frame:
    sender = dialect.MAVLink(None, *map(int, source.split(":")))
    return Frame(
        t_ns=START_NS + round(t_s * S),
        link="udp",
        source=Source.parse(source),
        msgid=message.get_msgId(),
        raw=message.pack(sender),
    )


def position(
    t_s: float,
    source: str,
    ned_m: Iterable[float],
    velocity: Iterable[float] = (0, 0, 0),
    late_s: float = 0.0,
) -> Frame:
    """Return a report made at a time, by a boot clock that started 100 s before, with a latency."""
    north, east, down = ned_m
    message = dialect.MAVLink_global_position_int_message(
        round((100 + t_s) * 1000),
        round((LAT + north / M_PER_DEG) * 1e7),
        round((LON + east / M_PER_DEG / math.cos(math.radians(LAT))) * 1e7),
        round((ALT_M - down) * 1000), 0, *(round(100 * v) for v in velocity), 65535,
    )  # fmt: skip
    return sent(t_s + late_s, source, message)


def heartbeat(t_s: float, source: str, mav_type: int, autopilot: int = 3) -> Frame:
    return sent(t_s, source, dialect.MAVLink_heartbeat_message(mav_type, autopilot, 0, 0, 4, 3))


def receiver(t_s: float, source: str, fix_type: int, alt_m: float) -> Frame:
    message = dialect.MAVLink_gps_raw_int_message(
        round(t_s * 1e6), fix_type, round(LAT * 1e7), round(LON * 1e7), round(alt_m * 1e3),
        100, 100, 0, 0, 12,
    )  # fmt: skip
    return sent(t_s, source, message)


def pipeline(center: str = f"{LAT},{LON},{ALT_M}", **sections: dict[str, Any]) -> Pipeline:
    return Pipeline(Settings().override(center={"source": center}, **sections))


def run(into: Pipeline, events: Iterable[Frame | Tick]) -> list[Output]:
    return [output for event in events for output in into.step(event)]


def turning(
    uav: str, seconds: float, speed: float = 22.0, radius: float = 60.0, rate_hz: int = 10
) -> list[Frame]:
    """Return circles of 8 m/s²."""
    frames = []
    for n in range(int(seconds * rate_hz)):
        t_s, a = n / rate_hz, speed / radius * n / rate_hz
        place = (200 + radius * math.cos(a), radius * math.sin(a), -60)
        frames.append(position(t_s, uav, place, (-speed * math.sin(a), speed * math.cos(a), 0)))
    return frames


def test_turn_beyond_type_limit_is_announced_once_and_widens_the_bound() -> None:
    into = pipeline()
    first, *others = turning("1:1", 10)
    out = run(into, [first, heartbeat(0, "1:1", 2), *others])
    refuted = [one for one in out if isinstance(one, Refuted)]
    notices = [one for one in out if isinstance(one, Notice) and "acceleration" in one.text]
    assert refuted and refuted[0].t_ns - START_NS < S
    assert {(one.uav, one.setting) for one in refuted} == {
        ("1:1", "observer.acceleration_max_mps2")
    }
    assert 1 <= len(notices) <= 2
    assert "observer.acceleration_max_mps2" in notices[0].text
    now_ns = START_NS + 10 * S
    (track,) = into.tracks(now_ns, now_ns + S)
    assert track.limits.limits_source == "raised"
    assert track.limits.acceleration_max_mps2 > 7.0
    assert into.refuted("1:1") == len(refuted)
    assert not any(isinstance(one, Rejection) for one in out)


def test_aeroplane_turn_refutes_nothing() -> None:
    into = pipeline()
    out = run(into, [heartbeat(0, "1:1", 1), *turning("1:1", 10)])
    assert not any(isinstance(one, Refuted) for one in out)
    (track,) = into.tracks(START_NS + 10 * S, START_NS + 10 * S)
    assert (track.limits.limits_source, track.limits.acceleration_max_mps2) == ("type", 16.0)


@pytest.mark.parametrize("types", [(1, 2), (2, 1), (19, 1)])
def test_aircraft_that_changes_its_type_keeps_the_wider_assumptions(types: tuple[int, int]) -> None:
    """It takes off vertically and flies as an aeroplane, or back: in between it is both."""
    into = pipeline()
    out: list[Output] = []
    for number, frame in enumerate(turning("1:1", 10)):
        if number % 10 == 0:
            out += into.step(heartbeat(number / 10, "1:1", types[number >= 50]))
        out += into.step(frame)
    assumed = into.senders.assumed("1:1")
    assert assumed.limits.acceleration_max_mps2 == 16.0
    assert assumed.lag_s[0] <= -0.033
    if 2 in types:
        assert assumed.lag_s == (-0.033, 0.040)
    changed_ns = START_NS + 5 * S
    assert not [one for one in out if isinstance(one, Refuted) and one.t_ns > changed_ns]


def test_type_that_is_not_repeated_ends_after_a_minute() -> None:
    """One forged heartbeat before the vehicle appeared, or while its radio was silent."""
    into = pipeline()
    run(into, [heartbeat(0, "1:1", 1)])
    seen = []
    for second in range(1, 80):
        run(into, [heartbeat(second, "1:1", 2), position(second, "1:1", (100, 0, 0), (0, 0, 0))])
        seen.append(into.senders.assumed("1:1").limits.acceleration_max_mps2)
    assert seen == [16.0] * 60 + [4.0] * 19


def test_type_before_the_first_position_narrows_nothing() -> None:
    """Anybody may have stated it: the vehicle may be of any type until it states its own."""
    into = pipeline()
    run(into, [heartbeat(0, "1:1", 2), *turning("1:1", 3)])
    assert into.senders.assumed("1:1") == into.senders.assumed("1:2")
    run(into, [heartbeat(3, "1:1", 2)])
    assert into.senders.assumed("1:1").limits.acceleration_max_mps2 == 4.0


@pytest.mark.parametrize(("mav_type", "lag_s"), [(2, 0.0295), (1, -0.026)])
def test_position_lag_is_corrected(mav_type: int, lag_s: float) -> None:
    """Positions of ArduPilot copters lag their stamps, those of aeroplanes lead them."""
    into = pipeline()
    first, second = (position(t_s, "1:1", (90 + 10 * t_s, 0, 0), (10, 0, 0)) for t_s in (0, 1))
    out = run(into, [first, heartbeat(0.5, "1:1", mav_type), second])
    (_, estimate) = (one for one in out if isinstance(one, Estimate))
    assert (START_NS + S - estimate.fix.t_ns) / S == pytest.approx(lag_s, abs=1e-3)
    assert (101 * S - estimate.fix.sender_ns) / S == pytest.approx(lag_s, abs=1e-9)


def test_temporary_step_is_not_a_duplicate_id() -> None:
    """Six metres aside for four seconds: reacquired after one second, and again on return."""
    into, rejected = pipeline(), []
    for n in range(200):
        t_s = n / 10
        aside = 6.0 if 8 <= t_s < 12 else 0.0
        frame = position(t_s, "1:1", (100, 5 * t_s + aside, 0), (0, 5, 0))
        rejected += [one for one in into.step(frame) if isinstance(one, Rejection)]
    assert {one.reason for one in rejected} <= {Reason.UNREACHABLE}
    assert len(rejected) <= 22
    assert [one for one in rejected if one.t_ns > START_NS + 13.2 * S] == []


def test_reports_of_a_fast_accurate_aircraft_are_all_accepted() -> None:
    """150 m/s at 20 Hz with 1 cm accuracy: one millisecond is more than that."""
    into = pipeline(observer={"speed_max_mps": 160.0})
    good = dialect.MAVLink_gps_raw_int_message(
        0, 6, 0, 0, round((ALT_M + 100) * 1e3), 100, 100, 0, 0, 12, 0, 10, 10, 10
    )
    out = run(into, [heartbeat(0, "1:1", 1, 12), sent(0, "1:1", good)])
    rng = np.random.default_rng(1)
    for n in range(600):
        made = n / 20 + rng.uniform(0, 1e-3)
        place = np.array([150.0 * made, 0, -100]) + rng.uniform(-0.005, 0.005, 3)
        out += into.step(position(n / 20, "1:1", place, (150, 0, 0)))
    assert not any(isinstance(one, Rejection) for one in out)


# --- clocks -------------------------------------------------------------------------------------


def test_stalled_clock_is_announced_and_refutes_the_drift_limit() -> None:
    into, out = pipeline(), []
    for n in range(600):
        t_s = n / 20
        stood_s = 0.0 if t_s < 20 else 0.15
        made = position(t_s - stood_s, "1:1", (100, 5 * t_s, 0), (0, 5, 0), late_s=stood_s)
        out += into.step(made)
    refuted = [one for one in out if isinstance(one, Refuted)]
    assert [one.setting for one in refuted] == ["clocks.drift_max_ppm"]
    assert 20 < (refuted[0].t_ns - START_NS) / S < 21.3
    out += into.step(Tick(START_NS + 30 * S))
    (told,) = (one for one in out if isinstance(one, Notice) and "clock stalled" in one.text)
    assert told.subject == "1:1" and "150 ms" in told.text


def test_changes_of_clocks_are_gathered_and_small_ones_left_out() -> None:
    notices = ClockNotices()

    def changed(t_s: float, sender: str, step_s: float) -> None:
        change = ClockChange(proven=True, step_s=step_s, drift_ppm=900.0)
        assert notices.add(START_NS + round(t_s * S), sender, change) is None

    def due(t_s: float) -> Notice | None:
        return notices.due(START_NS + round(t_s * S))

    changed(0, "1:1", 0.002)
    assert due(60) is None
    for number in range(1, 10):
        changed(60 + number / 10, f"{number}:1", 0.02 + number / 1000)
    assert due(65) is None
    first = due(65.2)
    assert first is not None
    assert first.severity is Severity.INFO
    assert first.text == (
        "clocks or links of 1:1, 2:1, 3:1, 4:1, 5:1, 6:1 and 3 more changed by up to 29 ms; the"
        " bounds cover it"
    )
    changed(70, "1:1", 0.5)
    assert due(100) is None
    second = due(125.2)
    assert second is not None
    assert (second.severity, second.subject) == (Severity.WARNING, "1:1")
    assert due(300) is None


def test_contradicting_round_trip_is_announced_at_most_once() -> None:
    into = pipeline()
    out = run(into, [position(n / 10, "1:1", (100, 0, 0)) for n in range(100)])
    for t_s, late_s in ((9.0, 0.0), (9.5, 0.4)):
        remote_ns = round((100 + t_s - late_s) * S)
        sent_ns = START_NS + round((t_s - 0.01) * S)
        trip = RoundTrip(
            t_ns=START_NS + round((t_s + 0.01) * S),
            source=Source(1, 1),
            sent_ns=sent_ns,
            remote_ns=remote_ns,
        )
        out += into.step(trip)
    assert into.clock_estimate("1:1") is not None
    changed = [one for one in out if isinstance(one, Notice) and "1:1: clock changed" in one.text]
    assert len(changed) <= 1


def test_undecoded_messages_update_the_clock() -> None:
    """Stamps of messages that are not decoded count between two reports of a slow link."""
    alone, helped = pipeline(), pipeline()
    for n in range(40):
        late_s = 0.8 if n % 4 else 0.05  # the reports are the slow messages
        frame = position(float(n), "1:1", (100, 0, 0), late_s=0.8)
        alone.step(frame)
        helped.step(frame)
        made = dialect.MAVLink_scaled_imu_message(round((100 + n + 0.5) * 1e3), *[0] * 9)
        helped.step(sent(n + 0.5 + late_s, "1:1", made))
    plain, known = alone.clock_estimate("1:1"), helped.clock_estimate("1:1")
    assert plain is not None and known is not None
    assert known.offset_ns < plain.offset_ns - 0.5 * S


# --- home ---------------------------------------------------------------------------------------


def test_home_waits_for_a_valid_receiver_status() -> None:
    """No fix, then a height that is hundreds of metres off, then both valid."""
    into = pipeline("home")
    out = run(into, [receiver(0.5, "1:1", 1, ALT_M), position(1, "1:1", (0, 0, 0))])
    assert [one.reason for one in out if isinstance(one, Rejection)] == [Reason.NO_FIX]
    out = run(into, [receiver(1.5, "1:1", 3, ALT_M), position(2, "1:1", (0, 0, 500.2))])
    assert [one.reason for one in out if isinstance(one, Rejection)] == [Reason.NO_FIX]
    assert into.local is None
    run(into, [position(3, "1:1", (0, 0, 0))])
    assert into.local is not None
    (update,) = (one for one in into.step(Tick(START_NS + 3 * S)) if isinstance(one, Update))
    assert update.carrier is not None


def test_home_waits_a_minute_for_a_status_that_is_not_repeated() -> None:
    """One forged status before the vehicle's first position; the vehicle itself sends none."""
    into = pipeline("home")
    run(into, [receiver(0.0, "1:1", 1, ALT_M), *(position(n, "1:1", (0, 0, 0)) for n in range(61))])
    assert into.local is None
    run(into, [position(61, "1:1", (0, 0, 0))])
    assert into.local is not None


def test_height_of_a_receiver_counts_for_a_minute() -> None:
    """One status of another height: the usual error is not its difference for ever."""
    there = pipeline("9:1")
    steady = [position(n / 5, "1:1", (0, 0, 0)) for n in range(350)]
    out = run(there, [*steady[:5], receiver(1.0, "1:1", 3, ALT_M + 500), *steady[5:]])
    apart_m = [
        (one.fix.t_ns - START_NS, one.fix.noise.apart_m) for one in out if isinstance(one, Estimate)
    ]
    assert max(apart for t_ns, apart in apart_m if t_ns < 60 * S) > 100
    assert all(apart == 0 for t_ns, apart in apart_m if t_ns > 61.1 * S)


def test_track_waits_for_receiver_status_at_most_ten_seconds() -> None:
    """One height is 500 m off for three seconds; another permanently."""
    into = pipeline("9:1")
    for uav, wrong_s in (("1:1", 3.0), ("2:1", 99.0)):
        out: list[Output] = []
        for n in range(75):
            t_s = n / 5
            off_m = 500.2 if t_s < wrong_s else 0.0
            said = [receiver(t_s, uav, 3, ALT_M)] if n % 5 == 0 else []
            out += run(into, [*said, position(t_s + 0.05, uav, (0, 0, off_m))])
        begun = next(one for one in out if isinstance(one, Estimate))
        waited_s = (begun.fix.t_ns - START_NS) * 1e-9
        assert waited_s == pytest.approx(min(wrong_s, 10.0), abs=0.3)
        refused = [one for one in out if isinstance(one, Rejection)]
        assert {one.reason for one in refused} == {Reason.NO_FIX}


def test_home_moves_after_a_wrong_first_height() -> None:
    """No receiver status arrived: the first height is used until the track jumps away from it."""
    into = pipeline("home")
    out = run(into, [position(n / 5, "1:1", (0, 0, 500.2 if n < 20 else 0)) for n in range(60)])
    moved = [one for one in out if isinstance(one, Notice) and one.subject == "home"]
    assert len(moved) == 2
    assert "home moved" in moved[1].text and "500.0 m" in moved[1].text
    now_ns = START_NS + 12 * S
    (track,) = into.tracks(now_ns, now_ns)
    assert abs(track.position_ned_m[2]) < 1.0


def test_clock_jump_beyond_possible_latency_is_announced() -> None:
    """A link that delayed all frames by 15 s looks the same: the notice names both causes."""
    there = pipeline()
    said = run(there, (position(0.1 * n, "7:1", (n, 0, 0), (10, 0, 0)) for n in range(300)))
    said += run(
        there, (position(30 + 0.1 * n, "7:1", (300 + n, 0, 0), (10, 0, 0), 15.0) for n in range(60))
    )
    told = [one for one in said if isinstance(one, Refuted)]
    assert [one.setting for one in told] == ["clocks.drift_max_ppm"]
    assert told[0].t_ns < START_NS + 48 * S
    texts = [one.text for one in said if isinstance(one, Notice)]
    assert any("arrive 15.0 s later than before; treated as a clock jump" in text for text in texts)


def test_link_that_becomes_fast_refutes_the_positions_before_it() -> None:
    """All frames of 20 s were 4 s late, and the last of them arrive between the first fast ones."""
    there = pipeline()
    frames = [
        position(0.1 * n, "7:1", (n, 0, 0), (10, 0, 0), 4.0 if n < 200 else 0.0) for n in range(300)
    ]
    said = run(there, sorted(frames, key=lambda frame: frame.t_ns))
    (told,) = [one for one in said if isinstance(one, Refuted)]
    assert (told.setting, told.limit) == ("clocks.constant_delay_s", 0.0)
    assert told.proven == pytest.approx(4.0, abs=0.1)
    assert told.t_ns < START_NS + 20.7 * S
    (notice,) = [one for one in said if isinstance(one, Notice) and "earlier" in one.text]
    assert (notice.t_ns, notice.severity) == (told.t_ns, Severity.WARNING)
    assert "until now its positions were 4.0 s older than assumed" in notice.text
    (track,) = there.tracks(START_NS + 30 * S, START_NS + 30 * S)
    off_m = math.dist(track.position_ned_m, (300, 0, 0))
    assert off_m < track.horizontal_bound_m


def test_limit_that_is_refuted_again_is_announced_again() -> None:
    """It decays: the bound was 10 m too small for 2 s, minutes after the only notice."""
    there = pipeline()

    def frames() -> Iterator[Frame]:
        east = 0.0
        for n in range(6000):
            moves = n % 2000 >= 1900  # for ten seconds, every 200 s
            east += 1.2 if moves else 0.0
            yield position(0.1 * n, "7:1", (100, east, 0))

    said = run(there, frames())
    notices = [one for one in said if isinstance(one, Notice) and "contradict" in one.text]
    for began_s in (190, 390, 590):
        since = [one for one in notices if 0 < (one.t_ns - START_NS) / S - began_s < 5.0]
        assert since, began_s


def test_velocities_that_the_positions_contradict_widen_the_bound() -> None:
    """A tracker that sends a velocity of zero: the bound broke with its last report."""
    there = pipeline()
    said = run(there, (position(0.1 * n, "7:1", (1.5 * n, 0, 0)) for n in range(100)))
    told = [one for one in said if isinstance(one, Refuted)]
    assert {one.setting for one in told} == {"observer.velocity_noise_mps"}
    assert told[0].t_ns < START_NS + 2 * S
    texts = [one.text for one in said if isinstance(one, Notice)]
    assert any("positions contradict its velocities" in text for text in texts)
    for ahead_s in (0.1, 0.5, 1.0, 2.0):
        at_ns = START_NS + round((9.9 + ahead_s) * S)
        (track,) = there.tracks(at_ns, at_ns)
        off_m = math.dist(track.position_ned_m, (15 * (9.9 + ahead_s), 0, 0))
        assert off_m < track.horizontal_bound_m
