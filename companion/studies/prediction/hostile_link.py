"""Hostile link: a sequence of latency regimes, drawn from a seed.

The node is switched on when the UAV flies: earlier messages never arrive, so that the link's first
frame arrives in flight. From then on the regimes follow one another, and repeat. Frames keep their
order, as in a queue, except in the regime in which they overtake one another. Nothing is thinned or
lost.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.studies.truth.trajectory import Times
from companion.values import BoolArray, FloatArray, IntArray

FAST_S: Final = 0.02
SLOW_S: Final = 0.5

Latency = Callable[[np.random.Generator, FloatArray], FloatArray]
"""Function from send times (n,) in a regime to latencies (n,), both in seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Regime:
    """Regime of a hostile link: name, duration, latency, and whether frames overtake."""

    name: str
    lasts_s: float
    latency_s: Latency
    overtakes: bool = False


def _first_fast(_rng: np.random.Generator, at_s: FloatArray) -> FloatArray:
    """Latency of 5 ms for the first frame, 0.3 s for all others."""
    return np.where(np.arange(len(at_s)) == 0, 0.005, 0.3)


def _steady(_rng: np.random.Generator, at_s: FloatArray) -> FloatArray:
    return np.full(len(at_s), FAST_S)


def _step(_rng: np.random.Generator, at_s: FloatArray) -> FloatArray:
    """Latency of 0.02 s, from the fifth second 0.5 s."""
    return np.where(at_s < 5, FAST_S, SLOW_S)


def _ramp(_rng: np.random.Generator, at_s: FloatArray) -> FloatArray:
    """Latency from 0.02 to 1 s within 20 s, constant for 5 s, and back within 20 s."""
    return np.interp(at_s, [0.0, 20.0, 25.0, 45.0], [FAST_S, 1.0, 1.0, FAST_S])


def _sawtooth(_rng: np.random.Generator, at_s: FloatArray) -> FloatArray:
    """Latency from 0 to 0.8 s within 6 s, repeatedly."""
    return 0.8 * (at_s % 6.0) / 6.0


def _wandering(rng: np.random.Generator, at_s: FloatArray) -> FloatArray:
    """Latency of 0.3 s with AR(1) noise: deviation 0.15 s, memory 2 s; at least 5 ms."""
    found = np.empty(len(at_s))
    now_s, last_s = 0.3, 0.0
    for row, drawn in enumerate(rng.standard_normal(len(at_s)).tolist()):
        keeps = float(np.exp(-(at_s[row] - last_s) / 2.0))
        now_s = 0.3 + keeps * (now_s - 0.3) + 0.15 * np.sqrt(1 - keeps * keeps) * drawn
        found[row], last_s = now_s, at_s[row]
    return np.maximum(found, 0.005)


def _bursts(rng: np.random.Generator, at_s: FloatArray) -> FloatArray:
    """Latency of a link open for 0.5 to 2 s, then blocked for 1 to 4 s, in turn."""
    found = np.full(len(at_s), FAST_S)
    opens_s = 0.0
    while len(at_s) and opens_s < at_s[-1]:
        shuts_s = opens_s + rng.uniform(0.5, 2.0)
        opens_s = shuts_s + rng.uniform(1.0, 4.0)
        held = (at_s >= shuts_s) & (at_s < opens_s)
        found[held] = opens_s - at_s[held] + FAST_S
    return found


def _changes(rng: np.random.Generator, at_s: FloatArray) -> FloatArray:
    """Latency that alternates every 4 s between a fast steady network and a slow jittery one."""
    slow = (at_s // 4.0) % 2 == 1
    jitter_s = rng.standard_exponential(len(at_s))
    return np.where(slow, 0.4 + 0.1 * jitter_s, FAST_S + 0.01 * jitter_s)


def _overtaking(rng: np.random.Generator, at_s: FloatArray) -> FloatArray:
    """Latency of up to 0.8 s, independent for each frame."""
    return rng.uniform(0.0, 0.8, len(at_s))


REGIMES: Final = (
    Regime(name="first-fast", lasts_s=20.0, latency_s=_first_fast),
    Regime(name="steady", lasts_s=10.0, latency_s=_steady),
    Regime(name="step", lasts_s=20.0, latency_s=_step),
    Regime(name="ramp", lasts_s=45.0, latency_s=_ramp),
    Regime(name="sawtooth", lasts_s=24.0, latency_s=_sawtooth),
    Regime(name="ar1", lasts_s=20.0, latency_s=_wandering),
    Regime(name="bursts", lasts_s=25.0, latency_s=_bursts),
    Regime(name="changes", lasts_s=24.0, latency_s=_changes),
    Regime(name="overtaking", lasts_s=16.0, latency_s=_overtaking, overtakes=True),
)
_STARTS_NS: Final = np.cumsum([0.0, *(regime.lasts_s for regime in REGIMES)]) * 1e9
ROUND_NS: Final = int(_STARTS_NS[-1])


def regimes_at(t_ns: Times, begins_ns: int) -> IntArray:
    """Return the index of the regime, in ``REGIMES``, at each time (n,)."""
    into_ns = (t_ns - begins_ns) % ROUND_NS
    return np.searchsorted(_STARTS_NS, into_ns, side="right") - 1


def arrivals_ns(
    rng: np.random.Generator, sent_ns: Times, begins_ns: int
) -> tuple[Times, BoolArray]:
    """Return arrival times of frames sent at ascending times (n,), and whether each arrives."""
    arrives = np.asarray(sent_ns >= begins_ns)
    arrival_ns = sent_ns.copy()
    rounds = (sent_ns - begins_ns) // ROUND_NS
    regime = regimes_at(sent_ns, begins_ns)
    queued = np.zeros(len(sent_ns), dtype=bool)
    for cycle in np.unique(rounds[arrives]).tolist():
        for number, one in enumerate(REGIMES):
            here = arrives & (rounds == cycle) & (regime == number)
            from_ns = begins_ns + cycle * ROUND_NS + _STARTS_NS[number]
            latency_s = one.latency_s(rng, (sent_ns[here] - from_ns) * 1e-9)
            arrival_ns[here] += np.round(latency_s * 1e9).astype(np.int64)
            queued |= here & (not one.overtakes)
    arrival_ns[queued] = np.maximum.accumulate(arrival_ns[queued])
    return arrival_ns, arrives
