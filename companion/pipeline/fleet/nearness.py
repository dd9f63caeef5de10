"""Which other nodes matter to this one: those that can hear or serve what it can.

Far from one another, two arrays have no UAV in common, and what one hears is nothing to the other.
So a node listens to the reports and the offers of those alone that are near, or whose reach meets
its own, and what it is told of UAVs does not grow with the fleet. What nodes say of themselves they
all hear: from that it follows who is near, and that a UAV has one node wherever it is.
"""

from collections.abc import Mapping
from typing import Final

from companion.tracking.geodesy import LocalFrame
from companion.values import Standing

Place = tuple[float, float, float]
COMES: Final = 1.1
"""Share of both reaches within which a node is near: more than 1, as reach is what was heard."""
GOES: Final = 1.3  # share of both beyond which one that was near is so no more
ALWAYS_M: Final = 10_000.0
"""Distance that is near whatever is heard: the farthest vehicle of a moment is no array's limit."""


def near(
    place: Place | None,
    reach_m: float | None,
    others: Mapping[str, Standing | None],
    before: frozenset[str],
) -> frozenset[str]:
    """The nodes that are near; all of which it is not known, since silence is no distance.

    place, reach_m  of this node's array, and how far it hears; who hears nobody has the other's
                    reach, as it may stand in a shadow
    others          what the others said last of themselves; None: nothing so far
    before          who was near until now
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
        limit_m = (GOES if node in before else COMES) * max(both_m, ALWAYS_M)
        if north * north + east * east <= limit_m * limit_m:
            found.add(node)
    return frozenset(found)
