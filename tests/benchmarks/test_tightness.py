"""The bound against the exact worst case, found by convex programmes over whole motions."""

import statistics
from itertools import pairwise

import adversary
import cvxpy as cp
import numpy as np
import pytest
from numpy.random import default_rng

from companion import Pipeline, Tick
from companion.values import Estimate, Fix, FloatArray

STEPS = 12
QUERIES = 40
REPORTS = 3
"""Reports that a motion has to agree with: older ones say nothing about the worst case."""


def furthest_m(fixes: list[Fix], until_ns: int, off: FloatArray, limit_mps2: float) -> float:
    """The greatest distance along a unit vector of a motion consistent with all reports.

    A second-order cone programme: accelerations are steps of at most ``limit_mps2``, and positions
    and velocities at the reports are within their noise. Returns the distance from the newest
    position.
    """
    newest = fixes[-1]
    times_s = sorted(
        {(fix.sender_ns - newest.sender_ns) * 1e-9 for fix in fixes}
        | set(np.linspace(0.0, (until_ns - newest.sender_ns) * 1e-9, STEPS).tolist())
    )
    place, velocity = cp.Variable((len(times_s), 3)), cp.Variable((len(times_s), 3))
    push = cp.Variable((len(times_s) - 1, 3))
    rules = [cp.norm(push, axis=1) <= limit_mps2]
    for k, (start_s, end_s) in enumerate(pairwise(times_s)):
        dt_s = end_s - start_s
        step = place[k] + velocity[k] * dt_s + push[k] * (dt_s**2 / 2)
        rules += [place[k + 1] == step, velocity[k + 1] == velocity[k] + push[k] * dt_s]
    for fix in fixes:
        at = times_s.index((fix.sender_ns - newest.sender_ns) * 1e-9)
        assert fix.velocity_ned_mps is not None
        said = np.array(fix.position_ned_m) - np.array(newest.position_ned_m)
        rules += [cp.norm(place[at] - said) <= fix.noise.position_m]
        rules += [cp.norm(velocity[at] - np.array(fix.velocity_ned_mps)) <= fix.noise.velocity_mps]
    at = times_s.index((until_ns - newest.sender_ns) * 1e-9)
    return float(cp.Problem(cp.Maximize(off @ place[at]), rules).solve(solver=cp.CLARABEL))


@pytest.mark.benchmark
def test_bound_is_close_to_the_exact_worst_case() -> None:
    """Over a slow radio, with turns; the worst-case direction is that of the bound's end."""
    genes = default_rng(5).random(adversary.GENES)
    genes[8 * adversary.KNOTS + 9] = 0.7  # a report each .8 s
    genes[8 * adversary.KNOTS + 14] = 0.0  # that is only heard
    pipeline = Pipeline(adversary.settings())
    rng = default_rng(6)
    fixes: list[Fix] = []
    ratios = []
    for event in adversary.Flight(genes).events():
        fixes += [said.fix for said in pipeline.step(event) if isinstance(said, Estimate)]
        fixes = sorted(fixes, key=lambda fix: fix.sender_ns)[-REPORTS:]
        if not isinstance(event, Tick) or len(fixes) < REPORTS or rng.random() > 0.2:
            continue
        valid_ns = event.t_ns + int(rng.choice([0, 300_000_000, 1_000_000_000]))
        (track,) = pipeline.tracks(event.t_ns, valid_ns)
        at = pipeline.senders.time(adversary.UAV, valid_ns)
        newest = fixes[-1]
        predicted = track.position_ned_m - np.array(newest.position_ned_m)
        exact_m = 0.0
        for end_s in (-at.before_s, at.after_s):
            until_ns = at.sender_ns + round(end_s * 1e9)
            age_s = (until_ns - newest.sender_ns) * 1e-9
            carried = np.array(newest.velocity_ned_mps) * age_s - predicted
            off = carried / np.linalg.norm(carried)
            most_m = furthest_m(fixes, until_ns, off, track.limits.acceleration_max_mps2)
            exact_m = max(exact_m, most_m - float(off @ predicted))
        ratios.append(track.bound_m / exact_m)
        if len(ratios) == QUERIES:
            break
    print(f"bound over the exact worst case: {statistics.median(ratios):.3f} in the median of")
    print(f"{len(ratios)}, {min(ratios):.3f} to {max(ratios):.3f}")
    assert min(ratios) > 0.999  # a feasible motion is inside the bound
    assert statistics.median(ratios) <= 1.05
