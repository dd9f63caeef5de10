"""The simulated radio: its output matches its settings and is reproducible."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from support import rounds

from companion.studies.prediction.delivery import Delivery, deliver
from companion.studies.prediction.radio_link import CLEAN, RADIO, RadioLink
from companion.studies.truth.vehicles import Flight

MakeFlight = Callable[..., Flight]


def latencies_s(flight: Flight, delivery: Delivery) -> np.ndarray:
    """The latency added to each report, matched by its unique position."""
    row_of = {tuple(position): row for row, position in enumerate(flight.position_ned_m)}
    rows = [row_of[tuple(each.position_ned_m)] for each in delivery.observed]
    arrived = np.array([each.arrival_ns for each in delivery.observed])
    return (arrived - flight.arrival_ns[rows]) * 1e-9


def test_clean_link_delivers_the_log_unchanged(straight_flight: MakeFlight) -> None:
    flight = straight_flight()
    delivery = deliver(flight, CLEAN, 1)
    assert [each.arrival_ns for each in delivery.observed] == flight.arrival_ns.tolist()
    assert (latencies_s(flight, delivery) == 0).all()
    assert delivery.rate_hz == pytest.approx(10)
    # A constant delay is unobservable.
    assert delivery.latency_s == pytest.approx(0, abs=1e-6)


def test_latency_loss_and_rate_match_the_link_settings(straight_flight: MakeFlight) -> None:
    reports = rounds(20_000, 60_000)
    flight = straight_flight(reports)
    delivery = deliver(flight, RADIO, 1)
    added_s = latencies_s(flight, delivery)
    assert np.median(added_s) == pytest.approx(0.6, rel=0.05)
    assert np.percentile(added_s, 95) == pytest.approx(2.2, rel=0.08)
    assert len(delivery.observed) == pytest.approx(reports / 10 * 1.2 * 0.9, rel=0.01)
    assert delivery.rate_hz == 1.2
    assert delivery.latency_s == 0.6
    arrivals = [each.arrival_ns for each in delivery.observed]
    assert arrivals == sorted(arrivals)
    sent = np.array([each.sent_ns for each in delivery.observed])
    assert 0.05 < np.mean(np.diff(sent) < 0) < 0.5  # reordered


def test_arrivals_are_seeded_per_uav(straight_flight: MakeFlight) -> None:
    def arrivals(uav: str, seed: int) -> list[int]:
        return [e.arrival_ns for e in deliver(straight_flight(uav=uav), RADIO, seed).observed]

    assert arrivals("1:1", 1) == arrivals("1:1", 1)
    assert arrivals("1:1", 1) != arrivals("1:1", 2)
    assert arrivals("1:1", 1) != arrivals("2:1", 1)


@pytest.mark.parametrize("known_delay", [False, True])
def test_clock_envelope_keeps_the_constant_latency(
    straight_flight: MakeFlight, known_delay: bool
) -> None:
    flight = straight_flight(3000)
    delivery = deliver(
        flight,
        RadioLink(
            name="radio", rate_hz=1.2, latency_s=(0.6, 2.2), loss=0.1, known_delay=known_delay
        ),
        1,
    )
    made_ns = {
        tuple(position): t_ns
        for position, t_ns in zip(flight.position_ned_m, flight.truth.t_ns, strict=True)
    }
    off_s = [(e.sent_ns - made_ns[tuple(e.position_ned_m)]) * 1e-9 for e in delivery.observed]
    off_s = off_s[100:]
    if known_delay:
        assert np.abs(np.array(off_s) - 0.005).max() < 1e-6  # of the log itself
    else:
        assert np.ptp(off_s) > 0.01
        assert abs(np.median(off_s)) < 0.3


def test_sender_timeline_continues_after_a_restart(straight_flight: MakeFlight) -> None:
    """Intervals are those of the sender's clock; at a restart, those of the node's clock."""
    flight = straight_flight(600)
    restarted = flight.boot_ms.copy()
    restarted[300:] -= restarted[300] - 42
    delivery = deliver(replace(flight, boot_ms=restarted), CLEAN, 1)
    made = np.array([each.sender_ns for each in delivery.observed])
    steps = np.diff(made) / 100_000_000
    assert steps == pytest.approx(np.round(steps))
    # Only the first timestamps after the restart are skipped until others confirm them.
    (gap,) = steps[steps > 1.5]
    assert gap < 8
    sent = np.array([each.sent_ns for each in delivery.observed])
    assert np.abs(made - sent).max() == 0


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"rate_hz": 0.0}, "give a positive number of Hz"),
        ({"rate_hz": float("nan")}, "give a positive number of Hz"),
        ({"latency_s": (2.0, 1.0)}, "MEDIAN,P95"),
        ({"latency_s": (0.0, 1.0)}, "MEDIAN,P95"),
        ({"loss": 1.0}, "give a share from 0 to below 1"),
        ({"loss": -0.1}, "give a share from 0 to below 1"),
    ],
)
def test_invalid_link_settings_are_rejected(values: dict[str, float], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        RadioLink(name="radio", **values)  # type: ignore[arg-type]
