"""The figures of the beam study: gains over time, the share to be swept, gains against time had."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.studies.beam_worth import Sample, Worth
from companion.studies.beams import Watched
from companion.studies.drawing import Anchor, Drawing, Line, Words
from companion.values import FloatArray

WIDTH: Final = 760
LEFT, RIGHT, TOP, BOTTOM = 46, 16, 20, 40
ROW: Final = 18
PANEL: Final = 104
BETWEEN: Final = 26
GRID: Final = "#dddddd"
FAINT: Final = "#555555"
BINS: Final = 330
"""Points of a line over time: of each bin the worst is drawn."""
RANGE_DB: Final = 35.0
"""Gains further below the largest are drawn at the edge."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A gain that is drawn, and how; ``unknown``: where there is none it is not known, rather than
    that nothing is guaranteed."""

    name: str
    colour: str
    width: float
    value: Callable[[Worth], float | None]
    unknown: bool = False


KINDS: Final = (
    Kind("predicted", "#8a8f98", 1.2, lambda worth: worth.gain_db),
    Kind("true", "#0b4f9e", 1.4, lambda worth: worth.true_gain_db, True),
    Kind("guaranteed", "#b3261e", 1.6, lambda worth: worth.guaranteed_gain_db),
)
COLOURS: Final = ("#0b4f9e", "#b3261e", "#00695c", "#6a1b9a", "#a65b00", "#37474f", "#ad1457")
DASHES: Final[tuple[tuple[float, ...], ...]] = ((), (6, 3), (2, 3), (9, 3, 2, 3), (12, 4))
SHARP_DASH: Final = (5.0, 3.0)
LETTER: Final = 6.6
"""About how wide a letter of a legend is."""
_NOWHERE: Final = np.empty((0, 2))


def charts(watched: Watched) -> dict[str, Drawing]:
    """The figures of one log by name; without a codebook there is no share to be swept."""
    found = {"gain": _gain(watched), "gain_had": _gain_had(watched)}
    if watched.codebook_beams is not None:
        found["sweep"] = _sweep(watched)
    return found


Entries = Sequence[tuple[str, Line]]


# --- a panel ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle of the drawing that shows x from and to, y from and to."""

    top: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    def place(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Points (N, 2) on the drawing; what lies beyond the panel is at its edge."""
        (x0, x1), (y0, y1) = self.x, self.y
        across = (np.clip(x, x0, x1) - x0) / (x1 - x0)
        up = (np.clip(y, y0, y1) - y0) / (y1 - y0)
        right = LEFT + across * (WIDTH - LEFT - RIGHT)
        return np.stack([right, self.top + (1 - up) * self.height], axis=1)

    def lines(self, x: FloatArray, y: FloatArray, how: Line) -> list[Line]:
        """A line with a gap wherever y is not a number; a lone point is a dot."""
        known = np.flatnonzero(~np.isnan(y))
        runs = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1) if len(known) else []
        placed = [self.place(x[run], y[run]) for run in runs]
        return [
            Line(np.repeat(p, 2, axis=0) if len(p) == 1 else p, how.colour, how.width, how.dash)
            for p in placed
        ]

    def frame(self, title: str, percent: bool, below: str | None) -> tuple[list[Line], list[Words]]:
        """Grid, ticks, title; ``below``: what x is, written under it (None: no ticks either)."""
        lines, words = [], [Words(LEFT, self.top - 7, title, size=12)]
        (x0, x1), (y0, y1) = self.x, self.y
        for y in _ticks(y0, y1, 5 if self.height > PANEL else 4):
            line = self.place(np.array([x0, x1]), np.array([y, y]))
            lines.append(Line(line, GRID))
            text = f"{100 * y:g} %" if percent else f"{y:g}"
            words.append(_tick(LEFT - 5, float(line[0, 1]) + 4, text, "end"))
        for x in _ticks(x0, x1, 8):
            line = self.place(np.array([x, x]), np.array([y0, y1]))
            lines.append(Line(line, GRID))
            if below is not None:
                words.append(_tick(float(line[0, 0]), self.top + self.height + 15, f"{x:g}"))
        if below is not None:
            middle = (LEFT + WIDTH - RIGHT) / 2
            words.append(Words(middle, self.top + self.height + 32, below, "middle", 12))
        return lines, words


def _tick(x: float, y: float, text: str, anchor: Anchor = "middle") -> Words:
    return Words(x, y, text, anchor, 11, FAINT)


def _ticks(low: float, high: float, most: int) -> list[float]:
    """At most about ``most`` round numbers from low to high: steps of 1, 2 or 5 and a power."""
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 9) for number in range(first, last + 1)]


def _legend(rows: Sequence[Entries]) -> tuple[list[Line], list[Words], float]:
    """Names above the panels, each row wrapped; and where the first panel begins."""
    lines, words, y = [], [], TOP - ROW
    for row in rows:
        at, y = float(LEFT), y + ROW
        for name, how in row:
            reach = 32 + LETTER * len(name)
            if at + reach > WIDTH - RIGHT:
                at, y = float(LEFT), y + ROW
            points = np.array([[at, y - 4], [at + 26, y - 4]])
            lines.append(Line(points, how.colour, max(how.width, 1.6), how.dash))
            words.append(Words(at + 32, y, name))
            at += reach + 24
    return lines, words, y + 30.0


# --- the figures --------------------------------------------------------------------------------


def _gain(watched: Watched) -> Drawing:
    """A panel for each UAV: gain by prediction, guaranteed and true over time."""
    by_uav = watched.by_uav
    kinds = _kinds(watched)
    edges = _edges(watched)
    y = _range_db(watched)
    lines, words, top = _legend([[(kind.name, _how(kind)) for kind in kinds]])
    for number, (uav, samples) in enumerate(by_uav.items()):
        panel = Panel(top + number * (PANEL + BETWEEN), PANEL, (edges[0], edges[-1]), y)
        last = number == len(by_uav) - 1
        framed = panel.frame(
            f"{uav}, array gain, dB", False, "time in the log, s" if last else None
        )
        lines, words = lines + framed[0], words + framed[1]
        for kind in kinds:
            lines += panel.lines(_middles(edges), _least(samples, edges, kind), _how(kind))
    height = round(top + len(by_uav) * (PANEL + BETWEEN) - BETWEEN + BOTTOM)
    title = f"{watched.log}: array gain over time, the least of each {_bin(edges)}"
    return Drawing(WIDTH, height, title, tuple(lines), tuple(words))


def _sweep(watched: Watched) -> Drawing:
    """A line for each UAV: what of the codebook must be swept."""
    edges = _edges(watched)
    hows = {
        uav: Line(_NOWHERE, COLOURS[n % len(COLOURS)], 1.4, DASHES[n % len(DASHES)])
        for n, uav in enumerate(watched.by_uav)
    }
    lines, words, top = _legend([list(hows.items())])
    shares = [s.sweep_share for s in watched.samples if s.sweep_share is not None]
    panel = Panel(top, 2 * PANEL, (edges[0], edges[-1]), (0.0, min(1.0, 1.15 * max(shares))))
    framed = panel.frame(
        f"share of the {watched.codebook_beams} stored beams that must be swept",
        True,
        "time in the log, s",
    )
    lines, words = lines + framed[0], words + framed[1]
    for uav, samples in watched.by_uav.items():
        values = _worst(samples, edges, lambda s: _or_nan(s.sweep_share), np.fmax)
        lines += panel.lines(_middles(edges), values, hows[uav])
    title = f"{watched.log}: share to be swept over time, the most of each {_bin(edges)}"
    return Drawing(WIDTH, round(top + panel.height + BOTTOM), title, tuple(lines), tuple(words))


def _gain_had(watched: Watched) -> Drawing:
    """The share of looks at which a gain is at least so much: as set, and sharp."""
    sets: list[tuple[str, tuple[float, ...], list[Worth | None]]]
    sets = [("", (), [sample.as_set for sample in watched.samples])]
    if watched.widen:
        sets.append((", sharp", SHARP_DASH, [sample.sharp for sample in watched.samples]))
    curves = [
        (kind.name + name, Line(_NOWHERE, kind.colour, kind.width, dash), _gains(worths, kind))
        for name, dash, worths in sets
        for kind in _kinds(watched)
    ]
    lines, words, top = _legend(
        [[(name, how) for name, how, _ in curves if how.dash == dash] for _, dash, _ in sets]
    )
    panel = Panel(top, 2.4 * PANEL, _range_db(watched), (0.0, 1.0))
    framed = panel.frame("share of looks at which the gain is at least", True, "array gain, dB")
    lines, words = lines + framed[0], words + framed[1]
    for _, how, gains in curves:
        share = 1 - np.arange(len(gains)) / max(len(gains), 1)
        shown = np.flatnonzero(gains >= panel.x[0])
        if len(shown):
            few = shown[np.linspace(0, len(shown) - 1, min(len(shown), BINS)).astype(int)]
            x, y = np.append(panel.x[0], gains[few]), np.append(share[few[0]], share[few])
            lines += panel.lines(x, y, how)
    title = f"{watched.log}: how much of the time a gain is had"
    return Drawing(WIDTH, round(top + panel.height + BOTTOM), title, tuple(lines), tuple(words))


def _gains(worths: Sequence[Worth | None], kind: Kind) -> FloatArray:
    """What the beams have of a kind, ascending; -inf where nothing is guaranteed."""
    found = np.array([_of(worth, kind.value) for worth in worths if worth is not None])
    if kind.unknown:
        found = found[np.isfinite(found)]
    return np.sort(found)


def _kinds(watched: Watched) -> list[Kind]:
    return [kind for kind in KINDS if watched.truth or not kind.unknown]


def _how(kind: Kind) -> Line:
    return Line(_NOWHERE, kind.colour, kind.width)


def _edges(watched: Watched) -> FloatArray:
    """Of the bins of time, (B + 1,): no more bins than looks, so that none is empty by itself."""
    times = np.unique([sample.t_s for sample in watched.samples])
    bins = int(np.clip(len(times) // 2, 1, BINS))
    begins, ends = float(times[0]), float(times[-1])
    return np.linspace(begins, max(ends, begins + 1.0), bins + 1)


def _bin(edges: FloatArray) -> str:
    return f"{edges[1] - edges[0]:.2g} s"


def _middles(edges: FloatArray) -> FloatArray:
    middles: FloatArray = (edges[1:] + edges[:-1]) / 2
    return middles


def _least(samples: Sequence[Sample], edges: FloatArray, kind: Kind) -> FloatArray:
    """The least gain of a kind in each bin (B,)."""
    return _worst(samples, edges, lambda sample: _of(sample.as_set, kind.value), np.fmin)


def _worst(
    samples: Sequence[Sample],
    edges: FloatArray,
    value: Callable[[Sample], float],
    worse: np.ufunc,
) -> FloatArray:
    """The worst in each bin (B,), NaN where nothing is; infinite values leave a gap as well."""
    found = np.full(len(edges) - 1, np.nan)
    where = np.clip(
        np.searchsorted(edges, [s.t_s for s in samples], "right") - 1, 0, len(found) - 1
    )
    worse.at(found, where, [value(sample) for sample in samples])
    found[np.isinf(found)] = np.nan
    return found


def _of(worth: Worth | None, value: Callable[[Worth], float | None]) -> float:
    """NaN without a beam; a beam that has nothing of it has it at minus infinity."""
    if worth is None:
        return math.nan
    found = value(worth)
    return -math.inf if found is None else found


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _range_db(watched: Watched) -> tuple[float, float]:
    """From and to, whole multiples of 5."""
    worths = [w for s in watched.samples for w in (s.as_set, s.sharp) if w is not None]
    values = [v for worth in worths for kind in KINDS if (v := kind.value(worth)) is not None]
    high = 5 * math.ceil(max(values) / 5 + 1e-9)
    low = 5 * math.floor(max(min(values), high - RANGE_DB) / 5)
    return float(low), float(max(high, low + 5))
