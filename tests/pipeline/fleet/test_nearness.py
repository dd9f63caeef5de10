"""Near nodes: those whose reach overlaps this node's, or may."""

import math

from hypothesis import given
from hypothesis import strategies as st

from companion.pipeline.fleet.nearness import ALWAYS_NEAR_M, ENTER_FACTOR, LEAVE_FACTOR, near
from companion.values import Standing

HERE = (47.0, 8.0, 400.0)
NOBODY: frozenset[str] = frozenset()
DEGREE_M = 111_195.0


def standing(east_m: float, reach_m: float | None) -> Standing:
    lon = HERE[1] + east_m / (DEGREE_M * math.cos(math.radians(HERE[0])))
    return Standing(node="b", place=(HERE[0], lon, 500.0), reach_m=reach_m, most=16, serves=())


@given(st.floats(0, 60_000), st.floats(1, 20_000), st.floats(1, 20_000))
def test_nodes_with_overlapping_reach_are_near(apart_m: float, own_m: float, its_m: float) -> None:
    found = near(HERE, own_m, {"b": standing(apart_m, its_m)}, NOBODY)
    if apart_m <= max(own_m + its_m, ALWAYS_NEAR_M):
        assert found == {"b"}
    elif apart_m > 1.02 * ENTER_FACTOR * max(own_m + its_m, ALWAYS_NEAR_M):
        assert found == NOBODY


def test_nearness_has_hysteresis() -> None:
    others = {"b": standing(0.5 * (ENTER_FACTOR + LEAVE_FACTOR) * 16_000, 8000.0)}
    assert near(HERE, 8000.0, others, NOBODY) == NOBODY
    assert near(HERE, 8000.0, others, frozenset(others)) == {"b"}


def test_node_without_reach_uses_that_of_the_other() -> None:
    for own_m, its_m in ((None, 8000.0), (8000.0, None)):
        assert near(HERE, own_m, {"b": standing(15_900, its_m)}, NOBODY) == {"b"}
        assert near(HERE, own_m, {"b": standing(24_000, its_m)}, NOBODY) == NOBODY
    assert near(HERE, None, {"b": standing(40_000, None)}, NOBODY) == NOBODY


def test_nodes_of_one_site_are_near_despite_short_reach() -> None:
    """One UAV circles a mast at 100 m; another mast behind a building receives only that UAV."""
    for own_m, its_m in ((100.0, None), (None, 400.0), (100.0, 200.0), (None, None)):
        assert near(HERE, own_m, {"b": standing(1500, its_m)}, NOBODY) == {"b"}


def test_nodes_of_unknown_position_are_near() -> None:
    lost = Standing(node="b", place=None, reach_m=10.0, most=16, serves=())
    assert near(HERE, 10.0, {"b": lost, "c": None}, NOBODY) == {"b", "c"}
    assert near(None, 10.0, {"b": standing(90_000, 10.0)}, NOBODY) == {"b"}
