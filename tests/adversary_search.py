"""Flights made to break the bounds, searched by CMA-ES: families of what an adversary may turn.

    python tests/adversary_search.py [QUERIES [FAMILY...]]

searches until each family has had its share of so many queries (a million unless said), and prints
the worst error over its bound for each. A query is one answer held against the truth. It ends with
status 1 if anything was outside, refused or called refuted though all assumptions were kept to.
"""

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import adversary
import adversary_carrier
import numpy as np
from adversary import KNOTS
from numpy.random import Generator, default_rng

from companion.values import BoolArray, FloatArray

QUERIES: Final = 1_000_000
STEP: Final = 0.3
"""Standard deviation of the first changes, of genes from 0 to 1."""
LEAST_STEP: Final = 0.02
"""Deviation below which the search begins again elsewhere."""


@dataclass(slots=True)
class Tried:
    """What a flight came to: the worst over its bound, what is wrong with it, queries."""

    ratio: float
    wrong: str
    queries: int


def fly(genes: FloatArray, number: int) -> Tried:
    """The flight of a UAV."""
    found = adversary.worst(adversary.Flight(genes, number))
    wrong = "; ".join((*found.refused[:1], *found.refuted[:1]))
    if max(found.ratio, found.outside - 1e-9) > 1:
        wrong = f"{found.at}; set {found.outside}; {wrong}"
    return Tried(max(found.ratio, found.outside), wrong, found.queries)


def turn(genes: FloatArray, number: int) -> Tried:
    """The flight of a UAV about a carrier that turns."""
    ratio, what, queries = adversary_carrier.worst(adversary_carrier.Turning(genes, number))
    return Tried(ratio, what if ratio > 1 else "", queries)


@dataclass(frozen=True, slots=True)
class Family:
    """Flights of a kind: what tries one, how many genes it has, which of them the search turns."""

    fly: Callable[[FloatArray, int], Tried]
    genes: int
    rows: tuple[int, ...]
    """Rows of ``KNOTS`` genes over time; all genes if none are named."""
    after: tuple[int, int] = (0, 0)
    """The first and the last but one of those behind the rows."""

    def turned(self) -> BoolArray:
        """Which genes are turned, (genes,)."""
        found = np.full(self.genes, not self.rows)
        for row in self.rows:
            found[row * KNOTS : (row + 1) * KNOTS] = True
        behind = 8 * KNOTS
        found[behind + self.after[0] : behind + self.after[1]] = True
        return found


FAMILIES: Final = {
    "accelerations": Family(fly, adversary.GENES, (0, 1, 2), (0, 2)),
    "latencies": Family(fly, adversary.GENES, (4,), (2, 14)),
    "clocks and round trips": Family(fly, adversary.GENES, (3, 4), (14, 24)),
    "signs of noise, and lags": Family(fly, adversary.GENES, (5, 6, 7), (15, 16)),
    "everything": Family(fly, adversary.GENES, ()),
    "turns and gaps of attitudes": Family(turn, adversary_carrier.GENES, ()),
}


def search(family: Family, rng: Generator) -> Iterator[Tried]:
    """Flights of a family, one after the other, by sep-CMA-ES: each goes for what is worse.

    Source: Ros and Hansen (2008), "A Simple Modification in CMA-ES". Genes are cut to 0 and 1, so
    that the edges, where most harm is, are often reached.
    """
    turned, number = family.turned(), 0
    while True:
        start = rng.random(family.genes)
        start = np.where(rng.random(family.genes) < 0.5, np.round(start), start)
        for asked in _evolution(start[turned], rng):
            harms = np.empty(len(asked))
            for row, genes in enumerate(asked):
                whole = start.copy()
                whole[turned] = np.clip(genes, 0.0, 1.0)
                tried = family.fly(whole, number)
                number += 1
                harms[row] = tried.ratio
                yield tried
            asked.told(harms)


class _Asked(list[FloatArray]):
    """Genes to be tried, and how much harm they did once that is told."""

    def told(self, harms: FloatArray) -> None:
        """Note the harms (n,)."""
        self.harms = harms


def _evolution(mean: FloatArray, rng: Generator) -> Iterator[_Asked]:
    n = len(mean)
    many = 4 + int(3 * math.log(n))
    best = many // 2
    weights = np.log(best + 0.5) - np.log(np.arange(1, best + 1))
    weights /= weights.sum()
    mass = 1.0 / float(weights @ weights)
    c_step = (mass + 2) / (n + mass + 5)
    damped = 1 + c_step + 2 * max(0.0, math.sqrt((mass - 1) / (n + 1)) - 1)
    c_path = 4 / (n + 4)
    c_one = (n + 2) / 3 * 2 / ((n + 1.3) ** 2 + mass)
    c_many = min(1 - c_one, (n + 2) / 3 * 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass))
    usual = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))
    step, variances = STEP, np.ones(n)
    path, step_path = np.zeros(n), np.zeros(n)
    while step > LEAST_STEP:
        drawn = rng.standard_normal((many, n)) * np.sqrt(variances)
        asked = _Asked(mean + step * drawn)
        yield asked
        order = np.argsort(-asked.harms, kind="stable")[:best]
        moved = weights @ drawn[order]
        mean = np.clip(mean + step * moved, -0.2, 1.2)
        step_path = (1 - c_step) * step_path + math.sqrt(
            c_step * (2 - c_step) * mass
        ) * moved / np.sqrt(variances)
        path = (1 - c_path) * path + math.sqrt(c_path * (2 - c_path) * mass) * moved
        variances = (
            (1 - c_one - c_many) * variances
            + c_one * path * path
            + c_many * (weights @ (drawn[order] ** 2))
        )
        step *= math.exp(c_step / damped * (float(np.linalg.norm(step_path)) / usual - 1))
        step = min(step, 1.0)


def main(queries: int, names: list[str]) -> int:
    """Search, print a line for each family, and return the status."""
    wrong = 0
    for name in names:
        asked, worst, flights = 0, 0.0, 0
        for tried in search(FAMILIES[name], default_rng(1)):
            asked, flights = asked + tried.queries, flights + 1
            worst = max(worst, tried.ratio)
            if tried.wrong:
                wrong += 1
                print(f"{name}, flight {flights}: {tried.wrong}", flush=True)
            if asked >= queries / len(FAMILIES):
                break
        print(f"{name}: {asked} queries, {flights} flights, worst {worst:.3f}", flush=True)
    return int(wrong > 0)


if __name__ == "__main__":
    given = int(sys.argv[1]) if len(sys.argv) > 1 else QUERIES
    sys.exit(main(given, sys.argv[2:] or list(FAMILIES)))
