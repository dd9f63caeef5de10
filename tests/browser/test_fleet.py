"""The page of a fleet node: complete at every size, and without axe violations."""

from typing import Any

import pytest
from support import HANG_MS, Node

from .test_accessibility import SIZES, violations
from .test_layout import CUT, OVERLAPS

pytestmark = [pytest.mark.browser, pytest.mark.full]

STATES = {"north": "here", "harbour-east": "there", "a-node-with-a-long-name": "silent",
          "liar": "aside"}  # fmt: skip


def fleet(answer: dict[str, Any], uavs: list[str]) -> dict[str, Any]:
    """Return a fleet of four nodes, one in each state, with UAVs in every serving state."""
    names = [name for name, state in STATES.items() if state != "aside"]
    nodes = [
        {
            "node": name, "is_self": state == "here", "state": state,
            "reason": "has an inconsistent clock" if state == "aside" else None,
            "place": {"lat_deg": 47.3977 + 0.002 * number, "lon_deg": 8.5456, "alt_m": 480.0},
            "reach_m": 900.0, "serves": 12, "most": 64, "heard_s": 75.2,
            "clock_offset_s": -0.0123, "clock_doubt_s": 0.0009, "frames": 100_000, "used": 12_345,
            "way_p50_ms": 20.0, "way_p99_ms": 841.0,
        }
        for number, (name, state) in enumerate(STATES.items())
    ]  # fmt: skip
    offers = [
        {"node": name, "sure_db": -11.9, "likely_db": 12.0, "sinr_db": 24.3, "heard_s": 0.1}
        for name in names
    ]
    ways: list[list[str]] = [[], names[:2], names[2:], names[:1]]
    served = [
        {"uav": uav, "served_by": ways[i % 4], "handing_to": names[1] if i % 4 == 3 else None,
         "unconfirmed": i % 2 == 0, "offers": offers}
        for i, uav in enumerate(uavs)
    ]  # fmt: skip
    handovers = [
        {"time": answer["valid_at"], "uav": uavs[0], "before": names[1], "after": names[2]}
    ] * 40
    said = {"node": "north", "site": "harbour", "nodes": nodes, "uavs": served}
    rates = {"sent_bps": 64_000.0, "heard_bps": 1.2e6, "damaged": 3}
    return answer | said | rates | {"handovers": handovers}


def join(node: Node, page: Any) -> None:
    """Show the node to the page as part of a fleet."""

    def uavs(route: Any) -> None:
        answer = node.json("/v1/uavs")
        for uav in answer["uavs"][1:]:
            uav |= {"verdict": None, "health": None, "served_by": ["a-node-with-a-long-name"]}
        route.fulfill(json=answer)

    ids = [uav["id"] for uav in node.json("/v1/uavs")["uavs"]]
    page.route("**/v1/uavs?*", uavs)
    page.route("**/v1/fleet", lambda way: way.fulfill(json=fleet(node.json("/v1/fleet"), ids)))
    page.route("**/v1/status", lambda way: way.fulfill(
        json=node.json("/v1/status") | {"node": "north"}))  # fmt: skip


@pytest.mark.parametrize(("size", "theme"), [(s, t) for s in SIZES for t in ("dark", "light")])
def test_fleet_page_is_complete_and_accessible(
    demo: Node, open_page: Any, size: str, theme: str
) -> None:
    page = open_page("about:blank", SIZES[size], theme=theme, loses_service=True)
    join(demo, page)
    page.goto(demo.url)
    page.locator("#fleet-uavs tbody tr").nth(3).wait_for(timeout=HANG_MS)
    page.locator("#links li dl").first.wait_for(state="attached", timeout=HANG_MS)
    page.locator("#headline", has_text="3 with other nodes").wait_for(timeout=HANG_MS)
    assert page.locator("#node-name").inner_text() == "north"
    assert page.locator("#fleet-nodes > li").count() == 4
    assert page.evaluate(OVERLAPS) == []
    assert page.evaluate(CUT) == []
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") == 0
    assert violations(page) == []
    page.locator("#fleet-uavs .pick").nth(1).click()
    page.locator("#drawer").wait_for(timeout=HANG_MS)
