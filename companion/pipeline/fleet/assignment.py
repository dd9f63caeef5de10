"""Which node serves which UAV: the same answer on every node that has the same offers.

A node is worth to a UAV the signal over noise that it guarantees it, in dB: by gain alone a node
far away would win, from which the same doubt of a position is a smaller angle. Its power is shared
by all that it serves, so a place at a node that has n already costs all of them together

    10 (n + 1) log10(n + 1) - 10 n log10(n)   dB.

From what is, UAVs without a node are given one; then UAVs move, one or several, each to the place
that the next one leaves, while there is a ring of such moves that gains anything. Where there is
none left the assignment is the best of all: a place more at a node costs more than the one before,
so this is a flow of least cost, and such rings are all that can better one (Klein, "A primal method
for minimal cost flows", 1967). To stay where it is is worth ``hysteresis_db`` to a UAV. No order of
arrival, no chance and no leader is in it.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from companion.values import FloatArray, IntArray, Offer

LIKELY_PENALTY_DB: Final = 10.0
"""Deduction for a gain that is only likely, not guaranteed."""
STEP_DB: Final = 0.1  # offers are told in whole steps, so that every node has the same numbers
UNSERVED_DB: Final = -1e6
"""Value of not being served: so low that every UAV that can be served is."""
MOVES: Final = 1000  # most rings of moves that one decision makes
ROUNDING_DB: Final = 1e-7  # what is less is no gain, but arithmetic


def offer_value_db(offer: Offer) -> float | None:
    """Value of an offer to its UAV; None where the node cannot serve it."""
    if offer.sinr_db is None or offer.sure_db is not None:
        return offer.sinr_db
    return offer.sinr_db - LIKELY_PENALTY_DB


def offer_values_db(offers: Mapping[str, Offer]) -> dict[str, float]:
    """The value of each offer that has one."""
    found = ((uav, offer_value_db(offer)) for uav, offer in offers.items())
    return {uav: worth for uav, worth in found if worth is not None}


def assign(
    offers: Mapping[str, Mapping[str, float]],
    holders: Mapping[str, str],
    most: Mapping[str, int],
    hysteresis_db: float,
    beside: Mapping[str, int] | None = None,
) -> dict[str, str]:
    """The node that is to serve each UAV; UAVs that no node has room for are left out.

    offers         worth of each node's offers, dB, by node and UAV
    holders        who serves a UAV now
    most           UAVs that each node serves at most
    hysteresis_db  least gain for which a UAV that is served changes its node
    beside         UAVs that a node serves beside those of the offers; None: none does
    """
    nodes = sorted(offers)
    uavs = sorted({uav for given in offers.values() for uav in given})
    if not nodes or not uavs:
        return {}
    nobody = len(nodes)
    given = [[offers[node].get(uav, -np.inf) for node in nodes] for uav in uavs]
    worth = np.column_stack([np.array(given), np.full(len(uavs), UNSERVED_DB)])
    rank = {node: number for number, node in enumerate(nodes)}
    at = np.array([rank.get(holders.get(uav, ""), nobody) for uav in uavs])
    each = np.arange(len(uavs))
    at[~np.isfinite(worth[each, at])] = nobody
    worth[each, at] += np.where(at == nobody, 0.0, hysteresis_db)
    room = np.array([*(most[node] for node in nodes), len(uavs)])
    others = np.array([*((beside or {}).get(node, 0) for node in nodes), 0])
    load = others + np.bincount(at, minlength=nobody + 1)
    _place(worth, room, at, load)
    _improve(worth, room, at, load)
    return {uav: nodes[at[i]] for i, uav in enumerate(uavs) if at[i] != nobody}


def _price_db(load: IntArray) -> FloatArray:
    """What one more costs all that a node serves, by how many it has; with nobody it is nothing."""
    more = load + 1.0
    price: FloatArray = 10.0 * (more * np.log10(more) - load * np.log10(np.maximum(load, 1.0)))
    price[-1] = 0.0
    return price


def _place(worth: FloatArray, room: IntArray, at: IntArray, load: IntArray) -> None:
    """Give UAVs without a node the best that has room: where moves begin, and no more."""
    nobody = len(room) - 1
    for i in np.flatnonzero(at == nobody):
        load[nobody] -= 1
        at[i] = np.argmax(np.where(load < room, worth[i] - _price_db(load), -np.inf))
        load[at[i]] += 1


def _improve(worth: FloatArray, room: IntArray, at: IntArray, load: IntArray) -> None:
    """Move UAVs, each to the place that the next one leaves, while that gains anything."""
    for _ in range(MOVES):
        gain, who = _gains_db(worth, at)
        left = _price_db(np.maximum(load - 1, 0))
        taken = np.where(load < room, _price_db(load), np.inf)
        outside = len(load)
        moves = _ring(np.block([[gain, -taken[:, None]], [left, -np.inf]]))
        if not moves:
            return
        for a, b in moves:
            if b == outside:  # the last one takes a place at a
                load[a] += 1
            elif a == outside:  # the first one leaves a place at b
                load[b] -= 1
            else:
                at[who[a, b]] = b


def _gains_db(worth: FloatArray, at: IntArray) -> tuple[FloatArray, IntArray]:
    """What it gains at most that one UAV moves from a node to another, (from, to), and which."""
    count = worth.shape[1]
    gain, who = np.full((count, count), -np.inf), np.zeros((count, count), dtype=int)
    for a in range(count):
        there = np.flatnonzero(at == a)
        if there.size:
            more = worth[there] - worth[there, a][:, None]
            gain[a], who[a] = more.max(axis=0), there[more.argmax(axis=0)]
            gain[a, a] = -np.inf
    return gain, who


def _ring(edges: FloatArray) -> list[tuple[int, int]]:
    """A ring of edges whose sum is more than nothing; empty where there is none (Bellman, Ford).

    ``edges`` are from row to column.
    """
    count = len(edges)
    best, before = np.zeros(count), np.full(count, -1)
    for _ in range(count):
        ways = best[:, None] + edges
        found = ways.max(axis=0)
        better = found > best + ROUNDING_DB
        if not better.any():
            return []
        before[better] = ways.argmax(axis=0)[better]
        best[better] = found[better]
    at = int(np.flatnonzero(better)[0])
    for _ in range(count):
        at = int(before[at])
    ring, end = list[tuple[int, int]](), at
    while not ring or at != end:
        ring.append((int(before[at]), at))
        at = int(before[at])
    return ring
