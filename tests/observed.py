"""Valid observations of both kinds, as strategies, and observations that break one rule each."""

import math
from dataclasses import replace
from typing import Any

from hypothesis import strategies as st

from companion.values import READINGS_MAX, Observation

TIMES = st.integers(0, 2**62 - 1)
_NAME = st.text("AZaz09._-", min_size=1, max_size=64)
UAVS = st.one_of(
    st.builds("{}:{}".format, st.integers(0, 255), st.integers(0, 255)),
    st.builds("icao:{:06X}".format, st.integers(0, 2**24 - 1)),
    st.builds("rid:{}".format, _NAME),
    st.builds("cot:{}".format, _NAME),
)
_COMMON: dict[str, Any] = {
    "t_ns": TIMES,
    "measured_ns": TIMES,
    "time_bound_ns": st.integers(0, 10_000_000_000),
    "uav": UAVS,
}
DIRECTIONS = st.builds(
    Observation,
    **_COMMON,
    azimuth_rad=st.floats(-math.pi, math.pi),
    elevation_rad=st.floats(-math.pi / 2, math.pi / 2),
    bound_rad=st.floats(0, math.pi, exclude_min=True),
)


@st.composite
def _powers(draw: st.DrawFn) -> Observation:
    beams = draw(st.lists(st.integers(0, 65_535), min_size=2, max_size=READINGS_MAX, unique=True))
    size = len(beams)
    powers_db = draw(st.lists(st.floats(-300, 300), min_size=size, max_size=size))
    return Observation(
        **{name: draw(values) for name, values in _COMMON.items()},
        beams=tuple(beams),
        powers_db=tuple(powers_db),
        power_bound_db=draw(st.floats(0, 60)),
        update=draw(st.none() | st.integers(0, 2**32 - 1)),
    )


POWERS = _powers()
OBSERVATIONS = DIRECTIONS | POWERS

DIRECTION = Observation(
    t_ns=1_700_000_000_000_000_000,
    measured_ns=1_699_999_999_990_000_000,
    time_bound_ns=2_000_000,
    uav="3:1",
    azimuth_rad=0.25,
    elevation_rad=-0.5,
    bound_rad=0.01,
)
POWER = replace(
    DIRECTION,
    azimuth_rad=None,
    elevation_rad=None,
    bound_rad=None,
    beams=(0, 7, 65_535),
    powers_db=(-60.5, -63.0, -71.25),
    power_bound_db=1.5,
    update=12_345,
)
NAN, INF = math.nan, math.inf
WRONG = {
    "name": (DIRECTION, {"uav": "UAV 3"}),
    "no name": (DIRECTION, {"uav": ""}),
    "system id": (DIRECTION, {"uav": "256:1"}),
    "component id": (DIRECTION, {"uav": "1:256"}),
    "digits of another script": (DIRECTION, {"uav": "١:١"}),
    "line break after the name": (DIRECTION, {"uav": "3:1\n"}),
    "long name": (DIRECTION, {"uav": "rid:" + 65 * "a"}),
    "lower case": (DIRECTION, {"uav": "icao:4ca7b3"}),
    "early arrival": (DIRECTION, {"t_ns": -1}),
    "late arrival": (DIRECTION, {"t_ns": 2**62}),
    "early measurement": (DIRECTION, {"measured_ns": -1}),
    "late measurement": (DIRECTION, {"measured_ns": 2**62}),
    "time bound below 0": (DIRECTION, {"time_bound_ns": -1}),
    "time bound": (DIRECTION, {"time_bound_ns": 10_000_000_001}),
    "azimuth": (DIRECTION, {"azimuth_rad": 3.15}),
    "azimuth NaN": (DIRECTION, {"azimuth_rad": NAN}),
    "azimuth infinite": (DIRECTION, {"azimuth_rad": -INF}),
    "elevation": (DIRECTION, {"elevation_rad": -1.58}),
    "elevation NaN": (DIRECTION, {"elevation_rad": NAN}),
    "bound 0": (DIRECTION, {"bound_rad": 0.0}),
    "bound": (DIRECTION, {"bound_rad": 3.15}),
    "bound NaN": (DIRECTION, {"bound_rad": NAN}),
    "no azimuth": (DIRECTION, {"azimuth_rad": None}),
    "no elevation": (DIRECTION, {"elevation_rad": None}),
    "no bound": (DIRECTION, {"bound_rad": None}),
    "neither": (POWER, {"beams": (), "powers_db": ()}),
    "both": (DIRECTION, {"beams": (1, 2), "powers_db": (1.0, 2.0)}),
    "powers without beams beside a direction": (DIRECTION, {"powers_db": (1.0, 2.0)}),
    "power bound of a direction": (DIRECTION, {"power_bound_db": 1.0}),
    "update of a direction": (DIRECTION, {"update": 1}),
    "one power": (POWER, {"beams": (1,), "powers_db": (1.0,)}),
    "many powers": (POWER, {"beams": tuple(range(257)), "powers_db": (0.0,) * 257}),
    "fewer powers than beams": (POWER, {"powers_db": (1.0, 2.0)}),
    "fewer beams than powers": (POWER, {"beams": (1, 2)}),
    "beam twice": (POWER, {"beams": (1, 2, 1)}),
    "beam below 0": (POWER, {"beams": (1, 2, -1)}),
    "beam": (POWER, {"beams": (1, 2, 65_536)}),
    "power": (POWER, {"powers_db": (1.0, 2.0, 300.5)}),
    "power NaN": (POWER, {"powers_db": (1.0, NAN, 2.0)}),
    "power infinite": (POWER, {"powers_db": (1.0, 2.0, -INF)}),
    "no power bound": (POWER, {"power_bound_db": None}),
    "power bound below 0": (POWER, {"power_bound_db": -0.5}),
    "power bound": (POWER, {"power_bound_db": 60.5}),
    "power bound NaN": (POWER, {"power_bound_db": NAN}),
    "update below 0": (POWER, {"update": -1}),
    "update": (POWER, {"update": 2**32}),
}


def wrong(name: str) -> Observation:
    """Return the invalid observation of this name in ``WRONG``."""
    valid, changes = WRONG[name]
    return replace(valid, **changes)
