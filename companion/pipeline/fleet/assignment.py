"""Which node serves which UAV: the same answer on every node that has the same offers.

A node is worth to a UAV the signal over noise that it guarantees it, in dB: by gain alone a node
far away would win, from which the same doubt of a position is a smaller angle. Its power is shared
by all that it serves, so a place at a node that has n already costs all of them together

    10 (n + 1) log10(n + 1) - 10 n log10(n)   dB.

From what is, UAVs without a node are placed first, those with the least choice before the others;
where all that could serve one are full, the best of them gives one to another node. Then single
UAVs move while a move gains more than ``hysteresis_db`` in all. No order of arrival, no chance and
no leader is in it.
"""

from collections.abc import Mapping
from typing import Final

import numpy as np

from companion.values import FloatArray, IntArray, Offer

UNSURE_DB: Final = 10.0
"""How much less a gain that is only likely is worth than one that is guaranteed."""
STEP_DB: Final = 0.1
"""Offers are told in whole steps, so that every node has the same numbers."""
MOVES: Final = 256
"""Most moves that one decision makes."""


def worth_db(offer: Offer) -> float | None:
    """What an offer is worth to its UAV; None where the node cannot serve it."""
    if offer.sinr_db is None or offer.sure_db is not None:
        return offer.sinr_db
    return offer.sinr_db - UNSURE_DB


def worths_db(offers: Mapping[str, Offer]) -> dict[str, float]:
    """What each offer is worth, of those that are worth anything."""
    found = ((uav, worth_db(offer)) for uav, offer in offers.items())
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
    worth = np.array([[offers[node].get(uav, -np.inf) for node in nodes] for uav in uavs])
    room = np.array([most[node] for node in nodes])
    rank = {node: number for number, node in enumerate(nodes)}
    at = np.array([rank.get(holders.get(uav, ""), -1) for uav in uavs])
    at[(at >= 0) & ~np.isfinite(worth[np.arange(len(uavs)), at])] = -1
    others = np.array([(beside or {}).get(node, 0) for node in nodes])
    load = others + np.bincount(at[at >= 0], minlength=len(nodes))
    _place(worth, room, at, load)
    _move(worth, room, at, load, hysteresis_db)
    return {uav: nodes[at[i]] for i, uav in enumerate(uavs) if at[i] >= 0}


def _price_db(load: IntArray) -> FloatArray:
    """What one more costs all that a node serves, by how many it has."""
    more = load + 1.0
    price: FloatArray = 10.0 * (more * np.log10(more) - load * np.log10(np.maximum(load, 1.0)))
    return price


def _place(worth: FloatArray, room: IntArray, at: IntArray, load: IntArray) -> None:
    """Give every UAV without a node the best that has room; who has least to choose from first."""
    free = np.flatnonzero(at < 0)
    ordered = np.sort(worth[free], axis=1)
    spare = np.full(len(free), np.inf)
    if worth.shape[1] > 1:
        best, second = ordered[:, -1], ordered[:, -2]
        has_choice = np.isfinite(second)
        spare[has_choice] = (best - second)[has_choice]
    for i in free[np.argsort(-spare, kind="stable")]:
        net = np.where(load < room, worth[i] - _price_db(load), -np.inf)
        node = int(np.argmax(net if np.isfinite(net).any() else worth[i]))
        if np.isfinite(net[node]) or _make_room(worth, room, at, load, i):
            at[i] = node
            load[node] += 1


def _make_room(worth: FloatArray, room: IntArray, at: IntArray, load: IntArray, uav: int) -> bool:
    """Move one of those at a UAV's best node elsewhere, the one that loses least by it.

    The node is full, and so are all others that could serve the UAV. Returns whether there is one.
    """
    node = int(np.argmax(worth[uav]))
    there = np.flatnonzero(at == node)
    if not there.size or not np.isfinite(worth[uav, node]):
        return False
    elsewhere = np.where(load < room, worth[there] - _price_db(load), -np.inf)
    elsewhere[:, node] = -np.inf
    lost = worth[there, node] - elsewhere.max(axis=1)
    least = int(np.argmin(lost))
    if not np.isfinite(lost[least]):
        return False
    to = int(np.argmax(elsewhere[least]))
    at[there[least]] = to
    load[to] += 1
    load[node] -= 1
    return True


def _move(
    worth: FloatArray, room: IntArray, at: IntArray, load: IntArray, hysteresis_db: float
) -> None:
    """Move single UAVs, the best move first, while one gains more than the hysteresis."""
    placed = np.flatnonzero(at >= 0)
    for _ in range(MOVES if placed.size else 0):
        price = _price_db(load)
        given_back = _price_db(np.maximum(load - 1, 0))
        here = at[placed]
        net = worth[placed] - np.where(load < room, price, np.inf)
        net[np.arange(placed.size), here] = -np.inf
        gain = net.max(axis=1) - worth[placed, here] + given_back[here]
        best = int(np.argmax(gain))
        if not gain[best] > hysteresis_db:
            return
        load[here[best]] -= 1
        at[placed[best]] = int(np.argmax(net[best]))
        load[at[placed[best]]] += 1
