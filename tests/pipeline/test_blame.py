"""Cause of a weak link: the largest part of its bound."""

from dataclasses import replace

import numpy as np
import pytest
import tracks

from companion.pipeline import blame
from companion.pipeline.angle_parts import AngleParts, angle_parts
from companion.pipeline.blame import CarrierEvidence, LinkEvidence
from companion.tracking.carrier import AttitudeParts
from companion.values import Beam, Carrier, Cause, LeftOut, Limits, Reason, Track, TrackState

FINE = LinkEvidence(clock_assumed=False, refused=None)
TRACK = tracks.track(
    np.zeros(3),
    uav="3:1",
    valid_at_ns=9,
    velocity_ned_mps=np.array([20.0, 0.0, 0.0]),
    bound_m=3.0,
    dt_s=0.1,
    latency_s=0.01,
    reports=9,
)
CARRIER = Carrier(
    valid_at_ns=9,
    position_ned_m=np.zeros(3),
    velocity_ned_mps=None,
    body_from_local=np.eye(3),
    body_rates_radps=np.zeros(3),
    bound_m=0.5,
    attitude_bound_rad=0.01,
    age_s=0.1,
)
BEAM = Beam(
    uav="3:1",
    azimuth_rad=0.0,
    elevation_rad=0.0,
    range_m=100.0,
    azimuth_rate_radps=None,
    elevation_rate_radps=None,
    range_rate_mps=None,
    pointing_bound_rad=0.04,
    gain_db=16.0,
    loss_db=0.5,
    widened=True,
)


def blamed(
    track: Track = TRACK,
    carrier: Carrier = CARRIER,
    beam: Beam = BEAM,
    evidence: LinkEvidence = FINE,
    when_good: AngleParts | None = None,
) -> tuple[Cause, str, str]:
    parts = angle_parts(beam, track, carrier, evidence.carrier.attitude, evidence.waited_s)
    found = blame.of_beam(beam, track, 10.0, evidence, parts, carrier=carrier, when_good=when_good)
    return found.cause, found.reason, found.remedy


@pytest.mark.parametrize(
    ("changed", "cause", "reason"),
    [
        ({}, Cause.POSITION, "at 100 m, its position is uncertain by 3 m"),
        ({"dt_s": 1.1, "age_s": 1.1, "bound_m": 5.0}, Cause.RATE, "reports 1.1 s apart"),
        ({"age_s": 0.9, "latency_s": 0.6, "dt_s": 0.2, "bound_m": 3.0}, Cause.LATE,
         "reports arrive 600 ms late"),
        ({"limits": Limits(60.0, 190.0), "age_s": 0.2, "bound_m": 5.0}, Cause.AGILE,
         "it may accelerate by up to 190 m/s²"),
        ({"clock_bound_s": 0.1}, Cause.CLOCK, "its clock is uncertain by 100 ms"),
        ({"age_s": 1.2}, Cause.SILENT, "no report for 1.2 s"),
    ],
)  # fmt: skip
def test_cause_is_the_largest_part_of_the_track_bound(
    changed: dict[str, object], cause: Cause, reason: str
) -> None:
    track = replace(TRACK, **changed)  # type: ignore[arg-type]
    assert blamed(track)[:2] == (cause, reason)
    own, relayed = blamed(track)[2], blamed(replace(track, uav="icao:4CA7B3"))[2]
    assert own != relayed and "MAVLink" not in relayed and "[presence]" not in relayed


def test_clock_is_blamed_for_acceleration_within_its_uncertainty() -> None:
    """4.8 s at 4 m/s^2 alone are 46 m, and more with the report's age."""
    doubted = replace(
        TRACK, velocity_ned_mps=np.array([11.5, 0.0, 0.0]), limits=Limits(60.0, 4.0), age_s=2.8,
        dt_s=3.5, clock_bound_s=4.8, bound_m=173.0,
    )  # fmt: skip
    assert blamed(doubted)[:2] == (Cause.CLOCK, "its clock is uncertain by 4.8 s")


def test_old_report_without_velocity_blames_the_report_rate() -> None:
    mute = replace(TRACK, velocity_ned_mps=None, dt_s=0.9, age_s=0.9, bound_m=58.0)
    assert blamed(mute)[0] is Cause.RATE
    assert blamed(replace(mute, bound_m=200.0))[0] is Cause.POSITION


def test_slow_reports_blame_the_rate_not_silence() -> None:
    """With 2 s between reports, an age of 4 s is one missing report, not a lost link."""
    assert blamed(replace(TRACK, age_s=4.0, dt_s=2.0, bound_m=60.0))[0] is Cause.RATE


def test_unmeasured_clock_remedy_is_timesync() -> None:
    assumed = LinkEvidence(clock_assumed=True, refused=None)
    cause, reason, remedy = blamed(replace(TRACK, clock_bound_s=0.1), evidence=assumed)
    assert (cause, reason) == (Cause.CLOCK, "its clock is unmeasured, uncertain by 100 ms")
    assert "TIMESYNC" in remedy


@pytest.mark.parametrize(
    ("attitude", "evidence", "reason", "remedy"),
    [
        (AttitudeParts(age_rad=0.19), {"attitude_age_s": 0.9}, "attitude is uncertain by 11°",
         "10 Hz"),
        (AttitudeParts(age_rad=0.19), {"attitude_age_s": 0.1}, "attitude is uncertain by 11°",
         "50 Hz"),
        (AttitudeParts(age_rad=0.19), {"attitude_age_s": 1.4}, "no attitude from the carrier",
         "power"),
        (AttitudeParts(error_rad=0.18, age_rad=0.01), {}, "is uncertain by 11°", "compass"),
        (AttitudeParts(clock_rad=0.19), {"clock_assumed": True}, "uncertain by 11°", "TIMESYNC"),
        (AttitudeParts(clock_rad=0.19), {}, "attitude is uncertain by 11°", "steadier"),
        (AttitudeParts(conflict_rad=0.19), {}, "contradict each other", "only one component"),
    ],
)  # fmt: skip
def test_carrier_is_blamed_for_its_attitude(
    attitude: AttitudeParts, evidence: dict[str, float], reason: str, remedy: str
) -> None:
    known = replace(FINE, carrier=CarrierEvidence(attitude=attitude, **evidence))  # type: ignore[arg-type]
    found = blamed(carrier=replace(CARRIER, attitude_bound_rad=0.2), evidence=known)
    assert found[0] is Cause.CARRIER
    assert reason in found[1]
    assert remedy in found[2]


def test_carrier_is_blamed_for_its_position() -> None:
    placed = blamed(carrier=replace(CARRIER, bound_m=8.0))
    assert placed[:2] == (Cause.CARRIER, "the carrier's position is uncertain by 8 m")
    silent = blamed(carrier=replace(CARRIER, bound_m=8.0, age_s=1.4))
    assert silent[1] == "no position from the carrier for 1.4 s"


@pytest.mark.parametrize(
    ("refused", "remedy"),
    [(Reason.REPLAYED, "signing"), (Reason.STRANGER, "routers"), (Reason.FROZEN, "receiver")],
)
def test_rejected_carrier_is_not_silent(refused: Reason, remedy: str) -> None:
    """Whatever is missing: its position, its attitude, or both, so that no UAV has a beam."""
    known = CarrierEvidence(
        attitude=AttitudeParts(age_rad=0.19), attitude_age_s=1.4, refused=refused
    )
    for carrier in (
        replace(CARRIER, bound_m=8.0, age_s=1.4),
        replace(CARRIER, attitude_bound_rad=0.2),
    ):
        found = blamed(carrier=carrier, evidence=replace(FINE, carrier=known))
        assert found[:2] == (Cause.CARRIER, f"the carrier's positions are rejected: {refused}")
        assert remedy in found[2]
    out = blame.of_left_out(LeftOut("3:1", Cause.CARRIER, "-"), TRACK, "no beams", refused)
    assert out.reason == f"no beams: its positions are rejected ({refused})"
    assert remedy in out.remedy


def test_wait_for_this_machine_is_blamed_on_it() -> None:
    """All of the age comes from this machine: neither the link nor the compass is at fault."""
    old = replace(TRACK, age_s=0.9, bound_m=5.0)
    aged = CarrierEvidence(attitude=AttitudeParts(waiting_rad=0.02))
    waiting = replace(FINE, waited_s=0.8, carrier=aged)
    turned = replace(CARRIER, attitude_bound_rad=0.03)
    found = blamed(old, turned, evidence=waiting)
    assert found[:2] == (Cause.MACHINE, "this machine is overloaded: frames wait up to 800 ms")
    assert blamed(replace(old, age_s=1.7), turned, evidence=waiting)[0] is Cause.MACHINE
    assert blamed(replace(old, age_s=2.7), turned, evidence=waiting)[0] is Cause.SILENT


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.004, "4 ms"), (0.03, "30 ms"), (0.8, "800 ms"), (1.0, "1.0 s"), (7.02, "7.0 s")],
)
def test_no_wait_is_rounded_to_zero(seconds: float, text: str) -> None:
    assert (
        blame.of_machine(seconds).reason == f"this machine is overloaded: frames wait up to {text}"
    )


@pytest.mark.parametrize(("bound_rad", "text"), [(0.0042, "0.24°"), (0.02, "1.1°"), (0.2, "11°")])
def test_no_uncertainty_is_rounded_to_zero(bound_rad: float, text: str) -> None:
    """The pointing bound of a large array may be a fraction of a degree."""
    turned = replace(CARRIER, attitude_bound_rad=bound_rad, bound_m=0.01)
    evidence = replace(FINE, carrier=CarrierEvidence(attitude=AttitudeParts(error_rad=bound_rad)))
    near = replace(TRACK, bound_m=0.01)
    reason = blamed(near, turned, evidence=evidence)[1]
    assert reason == f"the carrier's attitude is uncertain by {text}"


def test_what_grew_since_the_link_was_good_is_the_cause_even_if_another_part_is_larger() -> None:
    compass = AttitudeParts(error_rad=0.05)
    good = angle_parts(BEAM, TRACK, CARRIER, compass, 0.0)
    turned = replace(CARRIER, attitude_bound_rad=0.08)
    for more, word in (
        (AttitudeParts(error_rad=0.05, age_rad=0.03), "attitude_hz"),
        (AttitudeParts(error_rad=0.05, clock_rad=0.03), "steadier"),
        (AttitudeParts(error_rad=0.055), "compass"),  # within the tolerance: the largest part
    ):
        evidence = replace(FINE, carrier=CarrierEvidence(attitude=more))
        assert word in blamed(carrier=turned, evidence=evidence, when_good=good)[2]
        assert "compass" in blamed(carrier=turned, evidence=evidence)[2]


def test_steady_delay_is_late_not_silent() -> None:
    late = replace(TRACK, age_s=1.6, latency_s=1.5, dt_s=0.3, bound_m=8.0)
    assert blamed(late)[:2] == (Cause.LATE, "reports arrive 1.5 s late")
    assert blamed(replace(late, age_s=2.7))[0] is Cause.SILENT


def test_rejected_reports_are_the_first_cause() -> None:
    refused = LinkEvidence(clock_assumed=False, refused=Reason.UNREACHABLE)
    far = replace(CARRIER, attitude_bound_rad=0.5)
    found = blamed(replace(TRACK, age_s=9.0), far, evidence=refused)
    assert found[:2] == (Cause.REFUSED, "its reports are rejected: unreachable")


def test_forged_reports_do_not_explain_the_link_of_a_slow_vehicle() -> None:
    """Its own reports are used, 2 s apart; anybody may send unsigned ones in between."""
    forged = LinkEvidence(clock_assumed=False, refused=Reason.UNSIGNED)
    slow = replace(TRACK, age_s=3.0, dt_s=2.0, bound_m=60.0)
    assert blamed(slow, evidence=forged)[0] is not Cause.REFUSED
    assert blamed(replace(slow, age_s=7.0), evidence=forged)[0] is Cause.REFUSED


def test_narrow_beam_without_gain_is_crowded_or_out_of_range() -> None:
    crowded = replace(BEAM, gain_db=4.0, loss_db=14.0, widened=False)
    assert blamed(beam=crowded)[:2] == (Cause.CROWDED, "other UAVs in its direction cost it 14 dB")
    weak = replace(BEAM, gain_db=4.0, widened=False)
    assert blamed(beam=weak)[:2] == (
        Cause.RANGE,
        "at 100 m it needs 10 dB, but the array gives 4 dB",
    )
    assert blamed(beam=replace(crowded, widened=True))[0] is Cause.POSITION


def test_uav_without_beam_gets_the_left_out_reason() -> None:
    outside, crowded = (
        LeftOut("3:1", cause, "so it is") for cause in (Cause.COVERAGE, Cause.CROWDED)
    )
    assert blame.of_left_out(outside, TRACK, "the carrier is lost").cause is Cause.CARRIER
    for out in (outside, crowded):
        found = blame.of_left_out(out, TRACK, None)
        assert (found.cause, found.reason) == (out.cause, "so it is")
    stale = replace(TRACK, state=TrackState.STALE, age_s=12.0)
    found = blame.of_left_out(LeftOut("3:1", Cause.SILENT, "its reports are stale"), stale, None)
    assert (found.cause, found.reason) == (Cause.SILENT, "no report for 12.0 s")
    frozen = blame.of_left_out(LeftOut("3:1", Cause.SILENT, "stale"), stale, None, Reason.FROZEN)
    assert (frozen.cause, frozen.reason) == (Cause.REFUSED, "its reports are rejected: frozen")


def test_globally_silent_uav_is_not_blamed_on_missing_nodes() -> None:
    stale = replace(TRACK, state=TrackState.STALE, age_s=12.0)
    for track, reached, full, cause in (
        (stale, True, True, Cause.SILENT),
        (TRACK, False, True, Cause.COVERAGE),
        (TRACK, True, True, Cause.UNSERVED),
        (TRACK, True, False, Cause.UNSERVED),
    ):
        found = blame.of_unserved(track, reached=reached, full=full)
        assert found.cause is cause
        assert ("full" in found.reason) is (cause is Cause.UNSERVED and full)


def test_every_cause_has_a_reason_and_a_remedy() -> None:
    out = LeftOut(uav="3:1", cause=Cause.COVERAGE, reason="behind the array")
    found = [
        blame.of_left_out(out, TRACK, "no attitude from the carrier"),
        blame.of_left_out(out, TRACK, None),
        blame.of_unserved(TRACK, reached=False, full=False),
        blame.of_unserved(TRACK, reached=True, full=True),
        blame.of_unserved(TRACK, reached=True, full=False),
    ]
    assert [(one.cause, one.reason, one.remedy.split()[0]) for one in found] == [
        (Cause.CARRIER, "no attitude from the carrier", "check"),
        (Cause.COVERAGE, "behind the array", "turn"),
        (Cause.COVERAGE, "no node of the fleet reaches it", "turn"),
        (Cause.UNSERVED, "every node that reaches it is full", "raise"),
        (Cause.UNSERVED, "no node of the fleet serves it", "wait"),
    ]
