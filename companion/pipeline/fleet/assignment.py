"""Assignment of UAVs to nodes: identical on all nodes that have the same offers.

The value of a node to a UAV is the SNR that it guarantees, in dB. The gain alone would favour a
distant node, from which the same position error is a smaller angle. A node shares its power among
the UAVs that it serves, so one more UAV at a node with n costs all of them together

    10 (n + 1) log10(n + 1) - 10 n log10(n)   dB.

Starting from the current assignment, UAVs without a node are placed. Then UAVs move in cycles,
each to the node that the next one leaves, while such a cycle increases the sum. Each further UAV at
a node costs more than the one before, so this is a minimum cost flow: without an improving cycle
the assignment is optimal (Klein, "A primal method for minimal cost flows", 1967). A UAV's current
node has a bonus of ``hysteresis_db``. The result depends on no order of arrival, chance or leader.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from companion.values import FloatArray, IntArray, Offer

LIKELY_PENALTY_DB: Final = 10.0
"""Deduction from an offer whose gain is only likely, not guaranteed, dB."""
STEP_DB: Final = 0.1  # offers are rounded to steps, so that all nodes have the same numbers
UNSERVED_DB: Final = -1e6
"""Value of not being served, dB: so low that every UAV is served if possible."""
WORK_MAX: Final = 20_000_000
"""Most numbers that a search for cycles computes, some 50 ms; the next decision continues it.

A fleet of 32 nodes and 200 UAVs needs less, even if one node served a third of them before.
"""
LOOKED_EVERY: Final = 4  # rounds of the search after which it looks for a cycle
OPERATION: Final = 4000  # numbers that cost as much as one operation on an array
ROUNDING_DB: Final = 1e-7  # a smaller gain is a rounding error


def offer_value_db(offer: Offer) -> float | None:
    """Return the value of an offer to its UAV, dB; None if the node cannot serve the UAV."""
    if offer.sinr_db is None or offer.sure_db is not None:
        return offer.sinr_db
    return offer.sinr_db - LIKELY_PENALTY_DB


def offer_values_db(offers: Mapping[str, Offer]) -> dict[str, float]:
    """Return the values, dB, of all offers that can serve their UAV."""
    found = ((uav, offer_value_db(offer)) for uav, offer in offers.items())
    return {uav: worth for uav, worth in found if worth is not None}


def assign(
    offers: Mapping[str, Mapping[str, float]],
    holders: Mapping[str, str],
    most: Mapping[str, int],
    hysteresis_db: float,
    beside: Mapping[str, int] | None = None,
) -> dict[str, str]:
    """Return the node that should serve each UAV; UAVs for which no node has room are left out.

    offers         value of each node's offers, dB, by node and UAV
    holders        node that serves a UAV now
    most           largest number of UAVs that each node serves
    hysteresis_db  least gain for which a served UAV changes its node
    beside         UAVs that a node serves in addition to those of the offers; None: none
    """
    nodes = sorted(offers)
    uavs = sorted({uav for given in offers.values() for uav in given})
    if not nodes or not uavs:
        return {}
    unassigned = len(nodes)
    given = [[offers[node].get(uav, -np.inf) for node in nodes] for uav in uavs]
    worth = np.column_stack([np.array(given), np.full(len(uavs), UNSERVED_DB)])
    rank = {node: number for number, node in enumerate(nodes)}
    at = np.array([rank.get(holders.get(uav, ""), unassigned) for uav in uavs])
    each = np.arange(len(uavs))
    at[~np.isfinite(worth[each, at])] = unassigned
    worth[each, at] += np.where(at == unassigned, 0.0, hysteresis_db)
    room = np.array([*(most[node] for node in nodes), len(uavs)])
    others = np.array([*((beside or {}).get(node, 0) for node in nodes), 0])
    load = others + np.bincount(at, minlength=unassigned + 1)
    _place(worth, room, at, load)
    _improve(worth, room, at, load)
    return {uav: nodes[at[i]] for i, uav in enumerate(uavs) if at[i] != unassigned}


def _price_db(load: IntArray) -> FloatArray:
    """Return the cost of one more UAV by the node's load, dB; zero for not being served."""
    more = load + 1.0
    price: FloatArray = 10.0 * (more * np.log10(more) - load * np.log10(np.maximum(load, 1.0)))
    price[-1] = 0.0
    return price


def _place(worth: FloatArray, room: IntArray, at: IntArray, load: IntArray) -> None:
    """Assign each UAV without a node to the best node with room, as a start for the improvement."""
    unassigned = len(room) - 1
    for i in np.flatnonzero(at == unassigned):
        load[unassigned] -= 1
        at[i] = np.argmax(np.where(load < room, worth[i] - _price_db(load), -np.inf))
        load[at[i]] += 1


def _improve(worth: FloatArray, room: IntArray, at: IntArray, load: IntArray) -> None:
    """Move UAVs in cycles, each to the node that the next one leaves, while the sum increases.

    The last moves are left for the next decision if they take more than ``WORK_MAX``.
    """
    work, count = 0, len(load) + 1
    while work < WORK_MAX:
        gain, who = _gains_db(worth, at)
        left = _price_db(np.maximum(load - 1, 0))
        taken = np.where(load < room, _price_db(load), np.inf)
        outside = len(load)
        moves, rounds = _positive_cycle(np.block([[gain, -taken[:, None]], [left, -np.inf]]))
        work += count * OPERATION + rounds * (OPERATION + count * count)
        if not moves:
            return
        for a, b in moves:
            if b == outside:  # the last move fills a place at a
                load[a] += 1
            elif a == outside:  # the first move frees a place at b
                load[b] -= 1
            else:
                at[who[a, b]] = b


def _gains_db(worth: FloatArray, at: IntArray) -> tuple[FloatArray, IntArray]:
    """Return the largest gain, (from, to), of moving one UAV between two nodes, and that UAV."""
    count = worth.shape[1]
    gain, who = np.full((count, count), -np.inf), np.zeros((count, count), dtype=int)
    for a in range(count):
        there = np.flatnonzero(at == a)
        if there.size:
            more = worth[there] - worth[there, a][:, None]
            gain[a], who[a] = more.max(axis=0), there[more.argmax(axis=0)]
            gain[a, a] = -np.inf
    return gain, who


def _positive_cycle(edges: FloatArray) -> tuple[list[tuple[int, int]], int]:
    """Return a cycle of edges with a positive sum, empty without one, and the rounds that it took.

    ``edges`` lead from row to column (Bellman, Ford).
    """
    count = len(edges)
    best, before = np.zeros(count), np.full(count, -1)
    for rounds in range(count):
        ways = best[:, None] + edges
        found = ways.max(axis=0)
        better = found > best + ROUNDING_DB
        if not better.any():
            return [], rounds
        before[better] = ways.argmax(axis=0)[better]
        best[better] = found[better]
        if rounds % LOOKED_EVERY == LOOKED_EVERY - 1:
            cycle = _cycle(before.tolist())
            if cycle:
                return cycle, rounds
    return _cycle(before.tolist()), count


def _cycle(before: list[int]) -> list[tuple[int, int]]:
    """Return a cycle of best edges, which has a positive sum; empty without one.

    ``before`` is the node from which the best edge leads to each, -1 without one.
    """
    seen = [-1] * len(before)
    for start in range(len(before)):
        at = start
        while at >= 0 and seen[at] < 0:
            seen[at] = start
            at = before[at]
        if at >= 0 and seen[at] == start:
            cycle, end = [(before[at], at)], at
            while (at := before[at]) != end:
                cycle.append((before[at], at))
            return cycle
    return []
