"""A fleet node over HTTP: serving nodes, and their effect on verdicts and metrics."""

from collections.abc import Iterator
from typing import Any

import pytest
from starlette.testclient import TestClient

from companion.pipeline.fleet.member import FleetMember
from companion.server import models
from companion.server.app import create_app
from companion.settings.fleet import FleetSettings
from companion.values import Duty, Offer, Standing
from companion.views import fleet as fleet_view
from companion.views import state as state_view
from companion.views import uav_state
from companion.views.served import FleetStatus

from .conftest import StandIn, settings


def offer(uav: str, sinr_db: float | None = 30.0) -> Offer:
    return Offer(uav=uav, sure_db=sinr_db, likely_db=sinr_db, sinr_db=sinr_db, heard_s=0.1)


@pytest.fixture(scope="module")
def flown() -> StandIn:
    """Return a node that has received some UAVs."""
    return StandIn(settings())


@pytest.fixture
def north(flown: StandIn) -> Iterator[StandIn]:
    """Return a node that serves 1:1; another node, south, serves 2:1, and no node serves the
    rest.
    """
    now_ns = flown.now_ns()
    member = FleetMember(
        name="north", settings=FleetSettings(node="north"), elements=16, started_ns=now_ns
    )
    member.duties.serves["1:1"] = 20.0
    place = (47.0, 8.0, 480.0)
    member.take_standing(
        now_ns, Standing(node="south", place=place, reach_m=900.0, most=1, serves=(("2:1", 25.0),))
    )
    flown.fleet = FleetStatus(member=member, site="harbour", sent_bps=1e3, heard_bps=2e3, damaged=0)
    flown.pipeline.step(Duty(now_ns, ("1:1",)))
    flown.tick(0.0)
    yield flown
    flown.fleet = None


def client(node: StandIn) -> TestClient:
    return TestClient(create_app(node))


def uavs(node: StandIn) -> dict[str, Any]:
    answer = models.model(uav_state.Uavs).model_validate(client(node).get("/v1/uavs").json())
    return {uav.id: uav for uav in answer.uavs}


def test_uav_lists_its_serving_node(north: StandIn) -> None:
    found = uavs(north)
    assert found["1:1"].served_by == ["north"]
    assert found["1:1"].verdict is not None
    assert found["2:1"].served_by == ["south"]
    assert (found["2:1"].verdict, found["2:1"].health) == (None, None)


def test_received_and_used_frames_of_a_node_are_counted_separately(north: StandIn) -> None:
    assert north.fleet is not None
    known = north.fleet.member.neighbours["south"]
    known.frames, known.used = 7, 3
    nodes = client(north).get("/v1/fleet").json()["nodes"]
    (south,) = (one for one in nodes if one["node"] == "south")
    assert (south["frames"], south["used"]) == (7, 3)


def test_departed_node_stays_in_the_list(north: StandIn) -> None:
    assert north.fleet is not None
    north.fleet.member.node_left(north.now_ns(), "south")
    answer = models.model(fleet_view.Fleet).model_validate(client(north).get("/v1/fleet").json())
    assert [(one.node, one.state, one.serves) for one in answer.nodes] == [
        ("north", "here", 1),
        ("south", "gone", 0),
    ]
    south = answer.nodes[1]
    assert south.place is not None
    assert south.place.lat_deg == 47.0
    assert south.heard_s is not None
    assert 0.0 <= south.heard_s < 10.0
    assert 'companion_fleet_nodes{state="gone"} 1' in client(north).get("/metrics").text


def test_unserved_uav_has_no_link_and_a_reason(north: StandIn) -> None:
    assert north.fleet is not None
    alone = next(uav for uav, one in uavs(north).items() if one.served_by == [])

    def said() -> tuple[str | None, str | None]:
        one = uavs(north)[alone]
        assert one.verdict == "none"
        assert one.health is not None
        return one.health.cause, one.health.reason

    assert said() == ("coverage", "no node of the fleet reaches it")
    member = north.fleet.member
    member.take_offers(north.now_ns(), "south", (offer(alone), offer("2:1")))
    assert said() == ("unserved", "every node that reaches it is full")
    member.set_offers({alone: offer(alone)})
    assert said() == ("unserved", "no node of the fleet serves it")


def test_headline_counts_unserved_uavs_and_those_of_other_nodes(north: StandIn) -> None:
    found = uavs(north).values()
    alone = sum(one.served_by == [] for one in found)
    status = models.model(state_view.Status).model_validate(client(north).get("/v1/status").json())
    assert status.node == "north"
    assert status.health.none >= alone
    assert status.health.headline.endswith("links good, 1 with other nodes")
    assert f"of {1 + alone} links" in status.health.headline


def test_excluded_node_serves_no_uavs(north: StandIn) -> None:
    assert north.fleet is not None
    north.fleet.member.trust.excluded["south"] = "has an inconsistent clock"
    assert uavs(north)["2:1"].served_by == []
    answer = models.model(fleet_view.Fleet).model_validate(client(north).get("/v1/fleet").json())
    assert [node.state for node in answer.nodes] == ["here", "aside"]
    assert all("south" not in uav.served_by for uav in answer.uavs)


def test_no_serving_node_is_shown_without_a_fleet(shared_node: StandIn) -> None:
    assert {one.served_by for one in uavs(shared_node).values()} == {None}
    assert client(shared_node).get("/v1/status").json()["node"] is None
    assert "companion_fleet" not in client(shared_node).get("/metrics").text


def test_metrics_include_fleet_alarm_values(north: StandIn) -> None:
    assert north.fleet is not None
    member = north.fleet.member
    for _ in range(100):
        member.neighbours["south"].note_delay(north.now_ns(), 10_000_000)
    member.handed_over = 3
    alone = sum(one.served_by == [] for one in uavs(north).values())
    lines = client(north).get("/metrics").text.splitlines()
    for line in (
        'companion_fleet_nodes{state="here"} 1.0',
        'companion_fleet_nodes{state="there"} 1.0',
        'companion_fleet_nodes{state="aside"} 0.0',
        "companion_fleet_serves 1.0",
        "companion_fleet_most 16.0",
        "companion_fleet_elsewhere 1.0",
        f"companion_fleet_unserved {alone}.0",
        "companion_fleet_handovers_total 3.0",
        'companion_fleet_way_p99_seconds{node="south"} 0.01',
    ):
        assert line in lines
