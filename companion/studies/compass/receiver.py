"""Model of an array's receiver, which measures directions of UAVs within a bound."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.beams.array import steering
from companion.values import FloatArray, Observation

LATENCY_NS: Final = 20_000_000  # from a measurement to its arrival
ROUNDING: Final = 1.0 + 1e-6  # of stated bounds, for the rounding of angles


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayReceiver:
    """Receiver that measures each UAV at a rate.

    Errors are uniform over the cap of the bound; outliers are as far as a reflection, up to a
    radian.
    """

    name: str
    bound_deg: float
    outliers: float = 0.0  # share of measurements
    rate_hz: float = 10.0


RECEIVERS: Final = (
    ArrayReceiver(name="0.3 degrees", bound_deg=0.3),
    ArrayReceiver(name="0.5 degrees", bound_deg=0.5),
    ArrayReceiver(name="5 degrees", bound_deg=5.0),
    ArrayReceiver(name="0.5 degrees, 10 % outliers", bound_deg=0.5, outliers=0.1),
    ArrayReceiver(name="5 degrees, 10 % outliers", bound_deg=5.0, outliers=0.1),
)

Truth = Callable[[str, int], FloatArray | None]
"""Direction of a UAV in the true array frame, (3,), at a time; None if it is unknown."""


def observations(
    receiver: ArrayReceiver,
    uav: str,
    span_ns: tuple[int, int],
    truth: Truth,
    rng: np.random.Generator,
) -> Iterator[Observation]:
    """Yield measurements of a UAV within a span, in order of time."""
    period_ns = 1e9 / receiver.rate_hz
    bound_rad = math.radians(receiver.bound_deg)
    at = span_ns[0] + period_ns * rng.random()
    while at < span_ns[1]:
        at_ns = round(at)
        at += period_ns
        true = truth(uav, at_ns)
        if true is None:
            continue
        off_rad = bound_rad * math.sqrt(rng.random())
        if rng.random() < receiver.outliers:
            off_rad = bound_rad + float(rng.uniform(0.0, 1.0))
        seen = _tilted(rng, true, off_rad)
        (azimuth,), (elevation,) = steering.angles_rad(seen[np.newaxis])
        yield Observation(
            t_ns=at_ns + LATENCY_NS,
            measured_ns=at_ns,
            uav=uav,
            azimuth_rad=float(azimuth),
            elevation_rad=float(elevation),
            bound_rad=bound_rad * ROUNDING,
        )


def _tilted(rng: np.random.Generator, towards: FloatArray, by_rad: float) -> FloatArray:
    """Return a unit vector at an angle from another, in a random plane."""
    aside = np.cross(towards, rng.standard_normal(3))
    aside /= np.linalg.norm(aside)
    return math.cos(by_rad) * towards + math.sin(by_rad) * aside
