"""Near nodes: those that may receive or serve the same UAVs as this node.

Distant arrays have no UAV in common. So a node uses only the reports and offers of near nodes:
those within a fixed distance, or whose ranges overlap. Its traffic then does not grow with the
fleet. All nodes receive the standing of all others, which shows which are near, and ensures that
each UAV has one node wherever it is.
"""

from collections.abc import Mapping
from typing import Final

from companion.tracking.geodesy import LocalFrame
from companion.values import Standing

Place = tuple[float, float, float]
ENTER_FACTOR: Final = 1.1
"""Factor on the sum of two ranges within which a node becomes near.

More than 1, as a range is only the distance of the farthest vehicle received so far.
"""
LEAVE_FACTOR: Final = 1.3  # factor beyond which a near node ceases to be near
ALWAYS_NEAR_M: Final = 10_000.0
"""Distance within which a node is always near; a range is not an array's limit."""


def near(
    place: Place | None,
    reach_m: float | None,
    others: Mapping[str, Standing | None],
    before: frozenset[str],
) -> frozenset[str]:
    """Return the near nodes; all of them if this node's position is unknown.

    place, reach_m  position and range of this node's array; without a range, the other's is used,
                    as this array may be shadowed
    others          newest standing of each other node; None: none so far
    before          nodes that were near until now
    """
    if place is None:
        return frozenset(others)
    frame = LocalFrame(*place)
    found = set()
    for node, said in others.items():
        if said is None or said.place is None:
            found.add(node)
            continue
        reaches_m = [reach for reach in (reach_m, said.reach_m) if reach is not None]
        both_m = 2.0 * sum(reaches_m) / len(reaches_m) if reaches_m else 0.0
        north, east, _ = frame.localise(*said.place, None)[0]
        limit_m = (LEAVE_FACTOR if node in before else ENTER_FACTOR) * max(both_m, ALWAYS_NEAR_M)
        if north * north + east * east <= limit_m * limit_m:
            found.add(node)
    return frozenset(found)
