"""Questions where a UAV will be, a predictor's answers, and their scores."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from companion.beams.array.geometry import Array
from companion.studies.origin import Row
from companion.studies.prediction import hostile_link
from companion.studies.prediction.baselines import ObservedReport, Predicted, Predictor
from companion.studies.prediction.predictors import Product
from companion.studies.prediction.spectral import SNR_DB, loss_bps_hz
from companion.studies.truth.trajectory import Times
from companion.studies.truth.vehicles import Flight, Flown
from companion.values import FloatArray, Frame, IntArray, RoundTrip

ASK_HZ: Final = 20
HALF_BEAMWIDTH_DEG: Final = 0.79
"""Half-power half-width of 64 elements half a wavelength apart, broadside (docs/math.md 8.1)."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Questions:
    """Questions about one UAV: at times ``now_ns`` (K,), for each lead (L,).

    counts (L, K), whether the answer is scored: the UAV flies then, and both are known
    regime       (K,), index of the regime of a hostile link; None over other links
    """

    now_ns: Times
    leads_ns: Times
    truth_ned_m: FloatArray  # (L, K, 3), the UAV's true position at now + lead
    array_ned_m: FloatArray  # (L, K, 3), the array's true position at now + lead
    counts: NDArray[np.bool_]
    in_fault: NDArray[np.bool_]  # (L, K), whether a declared fault is between now and then
    regime: IntArray | None = None

    def every(self, step: int) -> "Questions":
        """Return every ``step``-th of the questions."""
        return replace(
            self,
            now_ns=self.now_ns[::step],
            truth_ned_m=self.truth_ned_m[:, ::step],
            array_ned_m=self.array_ned_m[:, ::step],
            counts=self.counts[:, ::step],
            in_fault=self.in_fault[:, ::step],
            regime=None if self.regime is None else self.regime[::step],
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Answers:
    """Answers of a predictor: positions (L, K, 3), bounds and usual errors (L, K); NaN if none.

    ``refuted_ns`` are the times at which the product reported that an assumption was refuted.
    """

    position_ned_m: FloatArray
    bound_m: FloatArray
    usual_m: FloatArray
    refuted_ns: tuple[int, ...] = ()


def questions(
    flown: Flown,
    flight: Flight,
    leads_s: Sequence[float],
    from_ns: int,
    begins_ns: int | None = None,
) -> Questions:
    """Return questions, ``ASK_HZ`` a second from ``from_ns``, while any answer is scored.

    ``begins_ns`` is when a hostile link was switched on.
    """
    step_ns = 1_000_000_000 // ASK_HZ
    start_ns = -(-max(from_ns, flown.span_ns[0]) // step_ns) * step_ns
    now_ns = np.arange(start_ns, flown.span_ns[1] + 1, step_ns)
    leads_ns = np.array([round(lead_s * 1e9) for lead_s in leads_s], dtype=np.int64)
    at_ns = (now_ns + leads_ns[:, None]).ravel()
    shape = (len(leads_ns), len(now_ns))
    position = flight.truth.at(at_ns)[0]
    array = flown.carrier_at(at_ns)
    known = ~np.isnan(position).any(axis=1) & ~np.isnan(array).any(axis=1)
    counts = (known & flight.flying(at_ns)).reshape(shape)
    in_fault = flight.in_fault(np.broadcast_to(now_ns, shape), at_ns.reshape(shape))
    asked = counts.any(axis=0)
    regime = None
    if begins_ns is not None:
        regime = hostile_link.regimes_at(now_ns, begins_ns)[asked]
    return Questions(
        now_ns=now_ns[asked],
        leads_ns=leads_ns,
        truth_ned_m=position.reshape(*shape, 3)[:, asked],
        array_ned_m=array.reshape(*shape, 3)[:, asked],
        counts=counts[:, asked],
        in_fault=in_fault[:, asked],
        regime=regime,
    )


def answers(predictor: Predictor, observed: Sequence[ObservedReport], asked: Questions) -> Answers:
    """Play the reports to a predictor, with the questions in between; return the answers."""
    came_ns = [each.arrival_ns for each in observed]
    return _played(predictor.report, observed, came_ns, predictor.predict, asked)


def product_answers(
    product: Product, events: Sequence[Frame | RoundTrip], asked: Questions
) -> Answers:
    """Play events to the product, with the questions in between; return the answers."""
    came_ns = [event.t_ns for event in events]
    given = _played(product.hear, events, came_ns, product.predict, asked)
    return replace(given, refuted_ns=tuple(product.refuted_ns))


Received = TypeVar("Received")


def _played(
    hear: Callable[[Received], None],
    said: Sequence[Received],
    came_ns: Sequence[int],
    predict: Callable[[int, int], Predicted | None],
    asked: Questions,
) -> Answers:
    shape = asked.counts.shape
    position, (bound, usual) = np.full((*shape, 3), np.nan), np.full((2, *shape), np.nan)
    leads_ns, arrived, total = asked.leads_ns.tolist(), 0, len(said)
    for k, now_ns in enumerate(asked.now_ns.tolist()):
        while arrived < total and came_ns[arrived] <= now_ns:
            hear(said[arrived])
            arrived += 1
        for j, lead_ns in enumerate(leads_ns):
            predicted = predict(now_ns, now_ns + lead_ns)
            if predicted is not None:
                position[j, k] = predicted.position_ned_m
                if predicted.bound_m is not None:
                    bound[j, k] = predicted.bound_m
                if predicted.usual_m is not None:
                    usual[j, k] = predicted.usual_m
    return Answers(position_ned_m=position, bound_m=bound, usual_m=usual)


def angles_deg(towards: FloatArray, truly: FloatArray) -> FloatArray:
    """Return angles between directions, (..., 3) each, degrees; exact also for small ones."""
    across = np.linalg.norm(np.cross(towards, truly), axis=-1)
    found: FloatArray = np.degrees(np.arctan2(across, np.sum(towards * truly, axis=-1)))
    return found


@dataclass(frozen=True, slots=True)
class Receiver:
    """Array that points at a UAV, and the SNR in dB at the UAV in the beam's middle."""

    array: Array
    snr_db: float = SNR_DB


def score(
    asked: Questions, given: Answers, lead: int, receiver: Receiver | None = None
) -> Row | None:
    """Return the figures of one lead; None if no answer counts. Bound figures may be None.

    ``bound_tightness`` is the median bound over the 95th percentile of the error: 1 would be a
    bound as small as the error. ``usual_covers`` is the share of answers with a usual error whose
    error was no larger. ``se_loss_bps_hz`` is the loss of ``receiver``, None without one.
    """
    counts = asked.counts[lead] & ~np.isnan(given.position_ned_m[lead, :, 0])
    if not counts.any():
        return None
    position, true = given.position_ned_m[lead, counts], asked.truth_ned_m[lead, counts]
    array, bound = asked.array_ned_m[lead, counts], given.bound_m[lead, counts]
    error_m = np.linalg.norm(position - true, axis=1)
    angle_deg = angles_deg(position - array, true - array)
    usual = given.usual_m[lead, counts]
    told = ~np.isnan(usual)
    bounded = not np.isnan(bound).any()
    p95_m, median_m = float(np.percentile(error_m, 95)), float(np.median(bound))
    return {
        "n": int(counts.sum()),
        "position_rms_m": _rms(error_m),
        "position_p95_m": p95_m,
        "position_max_m": float(error_m.max()),
        "angle_rms_deg": _rms(angle_deg),
        "angle_p95_deg": float(np.percentile(angle_deg, 95)),
        "angle_max_deg": float(angle_deg.max()),
        "within_beamwidth": float(np.mean(angle_deg <= HALF_BEAMWIDTH_DEG)),
        "se_loss_bps_hz": None
        if receiver is None
        else loss_bps_hz(receiver.array, position - array, true - array, receiver.snr_db),
        "bound_median_m": median_m if bounded else None,
        "bound_tightness": median_m / p95_m if bounded and p95_m else None,
        "usual_covers": float(np.mean(error_m[told] <= usual[told])) if told.any() else None,
    }


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
