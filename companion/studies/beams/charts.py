"""Figures of the beam study: gains over time, share to sweep, distribution of gains."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from companion.studies.beams.flight import StudiedFlight
from companion.studies.beams.worth import Sample, Worth
from companion.studies.figures import plotting
from companion.values import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN: Final = 7.2
BINS: Final = 330  # points of a line over time; the worst value of each bin is drawn
RANGE_DB: Final = 35.0  # range of gains drawn below the largest; lower ones are drawn at the edge


@dataclass(frozen=True, slots=True, kw_only=True)
class GainCurve:
    """Gain of the beams to draw."""

    name: str  # its name in the legend
    line: int  # number of its line style
    value: Callable[[Worth], float | None]  # getter
    unknown: bool = False  # whether None means "unknown" rather than "not guaranteed"


KINDS: Final = (
    GainCurve(name="predicted", line=2, value=lambda worth: worth.gain_db),
    GainCurve(name="true", line=1, value=lambda worth: worth.true_gain_db, unknown=True),
    GainCurve(name="guaranteed", line=0, value=lambda worth: worth.guaranteed_gain_db),
)


def charts(watched: StudiedFlight) -> dict[str, plotting.Draw]:
    """Return the figures of one log by name; the share to sweep needs a codebook."""
    found: dict[str, plotting.Draw]
    found = {"gain": partial(_gain, watched), "gain_had": partial(_gain_distribution, watched)}
    if watched.codebook_beams is not None:
        found["sweep"] = partial(_sweep, watched)
    return found


def _gain(watched: StudiedFlight) -> "Figure":
    by_uav, edges, (low, high) = watched.by_uav, _edges(watched), _range_db(watched)
    size_in = (WIDTH_IN, 0.9 + 1.25 * len(by_uav))
    figure, panels = plotting.new(len(by_uav), 1, size_in, sharex=True, sharey=True)
    for axes, (uav, samples) in zip(panels, by_uav.items(), strict=True):
        axes.set_title(uav, loc="left")
        for kind in _kinds(watched):
            least = np.clip(_least(samples, edges, kind), low, high)
            _over_time(axes, edges, least, kind.name, plotting.line(kind.line))
    panels[0].set_ylim(low, high)
    figure.supylabel("array gain, dB", fontsize=9)
    panels[-1].set_xlabel(f"time in the log, s; the least of each {_bin(edges)}")
    plotting.below(figure, panels[0], 3)
    return figure


def _sweep(watched: StudiedFlight) -> "Figure":
    edges = _edges(watched)
    figure, (axes,) = plotting.new(1, 1, (WIDTH_IN, 3.6))
    for number, (uav, samples) in enumerate(watched.by_uav.items()):
        most = _worst(
            samples, edges, lambda s: np.nan if s.sweep_share is None else s.sweep_share, np.fmax
        )
        _over_time(axes, edges, 100 * most, uav, plotting.line(number))
    axes.set_ylim(bottom=0)
    axes.set_ylabel(f"to be swept, % of {watched.codebook_beams} stored beams")
    axes.set_xlabel(f"time in the log, s; the most of each {_bin(edges)}")
    plotting.below(figure, axes, 8)
    return figure


def _gain_distribution(watched: StudiedFlight) -> "Figure":
    """Draw the share of samples with at least a given gain: as set, and sharp."""
    sets = {"as set": [sample.as_set for sample in watched.samples]}
    if watched.widen:
        sets["sharp"] = [sample.sharp for sample in watched.samples]
    low, high = _range_db(watched)
    figure, panels = plotting.new(1, len(sets), (WIDTH_IN, 3.6), sharex=True, sharey=True)
    for axes, (name, worths) in zip(panels, sets.items(), strict=True):
        axes.set_title(name)
        axes.set_xlabel("array gain, dB")
        for kind in _kinds(watched):
            gains = _gains(worths, kind)
            share = 100 * (1 - np.arange(len(gains)) / max(len(gains), 1))
            shown = np.flatnonzero(gains >= low)
            few = shown[np.linspace(0, len(shown) - 1, min(len(shown), BINS)).astype(int)]
            first = few[:1]  # extend the curve to the left edge
            x = np.append(np.full(len(first), low), gains[few])
            y = np.append(share[first], share[few])
            axes.plot(x, y, label=kind.name, **plotting.line(kind.line))
    panels[0].set_xlim(low, high)
    panels[0].set_ylim(0, 102)
    panels[0].set_ylabel("looks with at least that gain, %")
    plotting.below(figure, panels[0], 3)
    return figure


def _over_time(
    axes: "Axes", edges: FloatArray, values: FloatArray, label: str, how: dict[str, Any]
) -> None:
    """Draw a line through the middles of the bins, with a gap at each NaN.

    A single value between two gaps is a dot.
    """
    middles = (edges[1:] + edges[:-1]) / 2
    axes.plot(middles, values, label=label, **how)
    known = np.concatenate(([False], ~np.isnan(values), [False]))
    alone = known[1:-1] & ~known[:-2] & ~known[2:]
    axes.plot(middles[alone], values[alone], ".", color=how["color"])


def _gains(worths: Sequence[Worth | None], kind: GainCurve) -> FloatArray:
    """Return gains of one kind in ascending order; -inf if not guaranteed."""
    found = np.array([_of(worth, kind.value) for worth in worths if worth is not None])
    if kind.unknown:
        found = found[np.isfinite(found)]
    return np.sort(found)


def _kinds(watched: StudiedFlight) -> list[GainCurve]:
    return [kind for kind in KINDS if watched.truth or not kind.unknown]


def _edges(watched: StudiedFlight) -> FloatArray:
    """Return edges of the time bins, (B + 1,).

    There are at most half as many bins as sampling instants, so that no bin is empty by chance.
    """
    times = np.unique([sample.t_s for sample in watched.samples])
    bins = int(np.clip(len(times) // 2, 1, BINS))
    begins, ends = float(times[0]), float(times[-1])
    return np.linspace(begins, max(ends, begins + 1.0), bins + 1)


def _bin(edges: FloatArray) -> str:
    return f"{edges[1] - edges[0]:.2g} s"


def _least(samples: Sequence[Sample], edges: FloatArray, kind: GainCurve) -> FloatArray:
    return _worst(samples, edges, lambda sample: _of(sample.as_set, kind.value), np.fmin)


def _worst(
    samples: Sequence[Sample], edges: FloatArray, value: Callable[[Sample], float], worse: np.ufunc
) -> FloatArray:
    """Return the worst value in each bin (B,); NaN if it is infinite or the bin is empty."""
    found = np.full(len(edges) - 1, np.nan)
    where = np.clip(
        np.searchsorted(edges, [s.t_s for s in samples], "right") - 1, 0, len(found) - 1
    )
    worse.at(found, where, [value(sample) for sample in samples])
    found[np.isinf(found)] = np.nan
    return found


def _of(worth: Worth | None, value: Callable[[Worth], float | None]) -> float:
    """Return a gain of a beam, dB: NaN without a beam, -inf for a beam without that gain."""
    if worth is None:
        return math.nan
    found = value(worth)
    return -math.inf if found is None else found


def _range_db(watched: StudiedFlight) -> tuple[float, float]:
    """Return the lower and upper limit of the gain axis, multiples of 5."""
    worths = [w for s in watched.samples for w in (s.as_set, s.sharp) if w is not None]
    values = [v for worth in worths for kind in KINDS if (v := kind.value(worth)) is not None]
    high = 5 * math.ceil(max(values) / 5 + 1e-9)
    low = 5 * math.floor(max(min(values), high - RANGE_DB) / 5)
    return float(low), float(max(high, low + 5))
