"""Reports received by another node: the bound holds for any clock and link between the nodes."""

import math
import random
from dataclasses import dataclass

import pytest
from fleet_sky import FleetSky, off_m
from hypothesis import given, settings
from hypothesis import strategies as st
from support import rounds

from companion.mavlink.trust.dedupe import content
from companion.mavlink.wire.framing import Splitter
from companion.pipeline.fleet.neighbours import DRIFT_MAX, NeighbourClock
from companion.pipeline.fleet.reception import Reception
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Event, Frame, SharedFrame, Tick

S = 1_000_000_000
START_NS = 1_800_000_000 * S
UAV = "1:1"
SHADOW_S = 6.0
"""Time at which the vehicle flies behind the building."""
END_S = 12.0


@dataclass(kw_only=True)
class Links:
    """Latencies of the vehicle's and the nodes' links, and the other node's clock.

    uplink_s      least latency of the vehicle's reports at either node
    jitter_s      largest additional latency
    way_s         one-way latency between the nodes
    uneven_s      largest difference between the two directions
    offset_s      the other node's clock minus this one's
    drift         of the other node's clock
    """

    uplink_s: float
    jitter_s: float
    way_s: float
    uneven_s: float
    offset_s: float
    drift: float
    seed: int


def ns(seconds: float) -> int:
    return START_NS + round(seconds * S)


def flown(links: Links) -> tuple[list[tuple[float, float, float]], Pipeline]:
    """Return (time, error, bound) of each tick, and the final pipeline."""
    chance, sky = random.Random(links.seed), FleetSky(ports=[], uavs=1)
    pipeline = Pipeline(Settings().override(center={"source": "47.3977,8.5456,480"}))
    hearing, clock = Reception(), NeighbourClock()

    def there_ns(at_s: float) -> int:
        return ns(at_s + links.offset_s + links.drift * at_s)

    def way_s() -> float:
        return links.way_s + chance.uniform(0, links.uneven_s)

    happens: list[tuple[float, object]] = [
        (0.1 * n + 0.05, Tick(0)) for n in range(int(END_S * 10))
    ]
    for n in range(int(END_S * 2)):
        sent_s = n / 2
        read_s = sent_s + way_s()
        happens.append((read_s + way_s(), (ns(sent_s), there_ns(read_s))))
    for n in range(int(END_S * 10)):
        made_s = n / 10 + 0.003
        raw = sky.report(0, sky.begun_s + made_s)
        if made_s < SHADOW_S:
            arrival_s = made_s + links.uplink_s + chance.uniform(0, links.jitter_s)
            happens.append((arrival_s, Splitter("udp").feed(ns(arrival_s), raw)[0]))
        heard_s = made_s + links.uplink_s + chance.uniform(0, links.jitter_s)
        happens.append((heard_s + way_s(), SharedFrame(there_ns(heard_s), raw)))
    seen = []
    for at_s, what in sorted(happens, key=lambda one: one[0]):
        events: list[Event] = []
        match what:
            case Tick():
                events = [Tick(ns(at_s))]
            case Frame():
                events = [what]
                hearing.take_received(what)
            case SharedFrame():
                frame = hearing.to_own_timeline(ns(at_s), "b", clock, what)
                events += (
                    hearing.take_shared(ns(at_s), "b", frame, content(frame.raw)) if frame else []
                )
            case (sent_ns, remote_ns):
                clock.note_answer(sent_ns, ns(at_s), remote_ns)
        for event in events:
            pipeline.step(event)
        if isinstance(what, Tick):
            for track in pipeline.tracks(ns(at_s), ns(at_s)):
                lat, lon, alt = (
                    float(one[0]) for one in pipeline.geodetic(track.position_ned_m[None])
                )
                truth = sky.at(UAV, sky.begun_s + at_s + sky.utc_s)
                seen.append((at_s, off_m((lat, lon, alt), truth), track.bound_m))
    assert hearing.early == hearing.contradicted == []
    return seen, pipeline


@given(
    st.builds(
        Links,
        uplink_s=st.floats(0.001, 0.02),
        jitter_s=st.floats(0.0, 0.2),
        way_s=st.floats(0.0005, 0.15),
        uneven_s=st.floats(0.0, 0.1),
        offset_s=st.floats(-5.0, 5.0),
        drift=st.floats(-0.9 * DRIFT_MAX, 0.9 * DRIFT_MAX),
        seed=st.integers(0, 999),
    )
)
@settings(max_examples=rounds(4, 60))
def test_bound_holds_with_reports_from_another_node(links: Links) -> None:
    seen, pipeline = flown(links)
    broken = [(t, error, bound) for t, error, bound in seen if error > bound + 0.02]
    assert broken == []
    (track,) = pipeline.tracks(ns(END_S), ns(END_S))
    assert track.state in ("live", "coasting")
    assert any(t > SHADOW_S + 2 for t, _, _ in seen)


def test_shared_reports_keep_the_bound_small() -> None:
    links = Links(
        uplink_s=0.005,
        jitter_s=0.02,
        way_s=0.001,
        uneven_s=0.002,
        offset_s=3.0,
        drift=50e-6,
        seed=1,
    )
    seen, _ = flown(links)
    before = max(bound for t, _, bound in seen if 4 < t < SHADOW_S)
    behind = max(bound for t, _, bound in seen if t > SHADOW_S + 1)
    assert behind <= 1.5 * before
    assert math.isfinite(behind)


def test_neighbour_clock_uncertainty_widens_the_clock_estimate() -> None:
    """The node clock's uncertainty is part of the vehicle's and widens it equally."""
    narrow, wide = (
        flown(
            Links(
                uplink_s=0.005,
                jitter_s=0.0,
                way_s=0.001,
                uneven_s=uneven_s,
                offset_s=3.0,
                drift=0.0,
                seed=1,
            )
        )[1].clock_estimate(UAV)
        for uneven_s in (0.0, 0.4)
    )
    assert narrow is not None
    assert wide is not None
    assert wide.before_s + wide.after_s > narrow.before_s + narrow.after_s + 0.01


@pytest.mark.full
@pytest.mark.parametrize("seed", range(40))
def test_bound_holds_over_a_slow_inter_node_link(seed: int) -> None:
    chance = random.Random(seed)
    links = Links(
        uplink_s=0.002,
        jitter_s=chance.uniform(0, 0.5),
        way_s=chance.uniform(0, 0.5),
        uneven_s=0.3,
        offset_s=2.0,
        drift=DRIFT_MAX * 0.9,
        seed=seed,
    )
    seen, _ = flown(links)
    assert [one for one in seen if one[1] > one[2] + 0.02] == []
