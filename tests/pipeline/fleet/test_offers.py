"""A node's offers and reach, against its own beams and ranges."""

import math

import numpy as np
import pytest
from support import ROOT

from companion.beams.worth import link_budget
from companion.node.replay import log_events
from companion.pipeline.fleet import offers as batches
from companion.pipeline.fleet.member import FleetMember
from companion.pipeline.fleet.offers import Offers
from companion.pipeline.fleet.surroundings import Surroundings
from companion.pipeline.fold import Pipeline
from companion.settings.fleet import FleetSettings
from companion.settings.model import Settings
from companion.values import Frame

S = 1_000_000_000
SETTINGS = Settings().override(center={"source": "5:1"})


@pytest.fixture(scope="module")
def flown() -> tuple[Pipeline, FleetMember, int]:
    """Return a pipeline after some seconds of flight, its node's surroundings, and the time."""
    pipeline = Pipeline(SETTINGS)
    begun_ns, member = None, None
    for event in log_events([ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"], SETTINGS):
        if begun_ns is None or member is None:
            begun_ns = event.t_ns
            member = FleetMember(
                name="a",
                settings=FleetSettings(node="a"),
                elements=pipeline.array.size,
                started_ns=begun_ns,
            )
        if event.t_ns > begun_ns + 4 * S:
            return pipeline, member, event.t_ns
        pipeline.step(event)
        if isinstance(event, Frame):
            member.frame_received(event.t_ns, event)
    raise AssertionError


def test_offered_sinr_matches_gain_and_range(flown: tuple[Pipeline, FleetMember, int]) -> None:
    pipeline, member, now_ns = flown
    offers = Offers(pipeline, member.reception.silent_s)
    for _ in range(4):
        make = offers.look(now_ns)
        assert make is not None
        offers.take(make())
    assert offers.made.keys() >= {"1:1", "2:1", "3:1", "4:1"}
    carrier = pipeline.carrier(now_ns, now_ns)
    assert not isinstance(carrier, str)
    for track in pipeline.tracks(now_ns, now_ns, list(offers.made)):
        offer = offers.made[track.uav]
        assert offer.heard_s is not None
        range_m = np.linalg.norm([track.position_ned_m - carrier.position_ned_m], axis=1)
        budget, antennas = pipeline.precoder.budget, pipeline.precoder.uav_antennas
        (snr,) = link_budget.isotropic_snr(range_m, pipeline.array, budget, antennas)
        gain_db = offer.likely_db if offer.sure_db is None else offer.sure_db
        assert gain_db is not None
        assert offer.sinr_db == pytest.approx(10 * math.log10(snr) + gain_db, abs=0.4)


def test_offers_are_made_in_batches_of_limited_size(
    flown: tuple[Pipeline, FleetMember, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look that was late computed those of 2000 UAVs at once: 570 MB."""
    pipeline, member, now_ns = flown
    monkeypatch.setattr(batches, "MAX_BATCH", 3)
    offers = Offers(pipeline, member.reception.silent_s)
    for late_s in (0, 0, 100):
        make = offers.look(now_ns + late_s * S)
        assert make is not None
        made = make()
        assert 0 < len(made) <= 3
        offers.take(made)
    assert len(offers.made) >= 4


def test_reach_is_the_range_of_the_farthest_received_uav(
    flown: tuple[Pipeline, FleetMember, int],
) -> None:
    pipeline, member, now_ns = flown
    around = Surroundings(pipeline, member)
    carrier = pipeline.last_carrier
    assert carrier is not None
    reach_m = around.reach_m(now_ns)
    assert reach_m is not None
    away_m = [
        float(np.linalg.norm(track.position_ned_m - carrier.position_ned_m))
        for track in pipeline.tracks(now_ns, now_ns, ["1:1", "2:1", "3:1", "4:1"])
    ]
    assert reach_m == pytest.approx(max(away_m), abs=5.0)
    assert around.reach_m(now_ns + 6 * S) is None
